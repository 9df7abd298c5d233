"""From what the user passes to the form of a fit of several recordings: sensors, starts, groups."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.fitting.measured.readings import SENSOR_PARAMETERS, Group
from jeuler.fitting.measured.recording import Checked, Recording
from jeuler.fitting.parameters import Places
from jeuler.observing import Position, Sensor
from jeuler.observing.sensors import as_observation
from jeuler.particles.scene import Scene

OF_STATE = ("position", "velocity", "anchors")
LATEST = 0.1  # of the shortest span: the largest delay that is looked for unless bounds say otherwise


def as_sensor(observe: Any) -> Sensor:
    """The observation as a sensor that is not late, unless it is one."""
    return observe if isinstance(observe, Sensor) else Sensor(as_observation(observe))


def as_positions(record: Checked) -> np.ndarray | None:
    """Measured positions as (time, particle, dim) with NaN where none were; None of any other observation."""
    observation = record.sensor.observation
    if not isinstance(observation, Position) or checks.is_traced(record.targets):
        return None
    shape = record.state.position.shape
    full = np.full((len(record.times), *shape), np.nan)
    full[:, slice(None) if observation.particles is None else observation.particles[:]] = record.targets
    return full


def delay_bounds(
    bounds: Any, of_sensor: tuple[str, ...], recordings: Sequence[Recording]
) -> tuple[dict[str, Any], tuple[float, float] | None]:
    """Bounds with those of a delay that is fitted, and these alone; None where none is."""
    if "delay" not in of_sensor:
        return bounds, None
    spans = [float(np.ptp(np.asarray(r.times, float))) for r in recordings if np.size(r.times)]
    pair = (bounds or {}).get("delay", (0.0, LATEST * min(spans, default=0.0)))
    if not isinstance(pair, (tuple, list)) or len(pair) != 2 or not all(np.all(np.isfinite(b)) for b in pair):
        raise ValueError(f'bounds["delay"] must be a pair of two finite times (lower, upper), s, got {pair!r}')
    limits = float(np.min(pair[0])), float(np.max(pair[1]))
    for r in recordings:
        delay = float(as_sensor(r.observe).delay)
        if not limits[0] <= delay <= limits[1]:
            raise ValueError(
                f"a delay must start between its bounds, {limits[0]:g} to {limits[1]:g} s, got {delay:g} s; "
                f'pass bounds={{"delay": (lower, upper)}}'
            )
    return {**(bounds or {}), "delay": tuple(pair)}, limits


def own_names(per_recording: Any, names: tuple[str, ...]) -> tuple[str, ...]:
    """The parameters of which each recording has its own value."""
    if per_recording is None:
        return tuple(name for name in names if name in OF_STATE)
    if isinstance(per_recording, str):
        raise ValueError(f'per_recording must be a tuple of names such as ("velocity",), got {per_recording!r}')
    for name in per_recording:
        if name not in names:
            raise ValueError(f"per_recording must be among parameters, {names}, got {name!r}")
    return tuple(per_recording)


def starting_values(
    scene: Scene, records: Sequence[Checked], places: Places, of_sensor: tuple[str, ...], own: tuple[str, ...]
) -> dict[str, Any]:
    """The starting values, those of their own stacked."""
    each = []
    for r in records:
        names = {name: getattr(r.sensor, name) for name in of_sensor}
        each.append({**places.read(r.scene, r.state), **names})
    start = {**places.read(scene, records[0].state), **{n: each[0][n] for n in of_sensor}}
    for name in start:
        if name in own:
            try:
                start[name] = jax.tree.map(stacked, *[values[name] for values in each])
            except ValueError:
                raise ValueError(f"{name} must have one shape in all recordings, as each has its own") from None
        elif name in ("mass", *SENSOR_PARAMETERS, *OF_STATE):
            different = [k for k, v in enumerate(each) if not _same(v[name], start[name])]
            if different:
                raise ValueError(
                    f"{name} is one for all recordings, and recordings[{different[0]}] starts it elsewhere than the "
                    f"first; start it alike, or name it in per_recording"
                )
    return start


def _same(a: Any, b: Any) -> bool:
    return any(map(checks.is_traced, (a, b))) or np.array_equal(np.asarray(a), np.asarray(b))


def grouped(records: Sequence[Checked], dt: float) -> tuple[Group, ...]:
    """Recordings whose scenes, states and sensors have one form, side by side."""
    found: dict[Any, list[int]] = {}
    for k, r in enumerate(records):
        leaves, structure = jax.tree.flatten((r.scene, r.state, r.sensor))
        found.setdefault((structure, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)), []).append(k)
    return tuple(
        Group(
            tuple(members),
            max(records[k].num_steps for k in members),
            tuple(len(records[k].times) for k in members),
            tuple(records[k].columns for k in members),
        )
        for members in found.values()
    )


def stacked(*leaves: Any) -> Any:
    """Along a leading axis, by NumPy where nothing is traced or of JAX."""
    return jnp.stack(leaves) if any(isinstance(x, jax.Array) for x in leaves) else np.stack(leaves)


def period_of(sensor: Sensor) -> float | None:
    """Of a reading that comes back to itself, such as an angle in rad, of a gain that is 1."""
    period = getattr(sensor.observation, "period", None)
    known = not checks.is_traced(sensor.gain) and np.ndim(sensor.gain) == 0
    return period * abs(float(sensor.gain)) if period and known and float(sensor.gain) else None


def refuse_strangers(scene: Scene, records: Sequence[Checked]) -> None:
    """Recordings must be of the same forces and effects, and pin the same particles."""
    kinds = [type(part) for part in (*scene.forces, *scene.effects)]
    pinned = np.isinf(np.broadcast_to(np.asarray(records[0].state.mass), len(records[0].state.position)))
    for r in records:
        if [type(part) for part in (*r.scene.forces, *r.scene.effects)] != kinds:
            raise ValueError(f"{r.where}scene must have the forces and effects of the fit's scene, in their order")
        mass = np.broadcast_to(np.asarray(r.state.mass), len(r.state.position))
        if len(mass) != len(pinned) or (np.isinf(mass) != pinned).any():
            raise ValueError(f"{r.where}state must have the particles of the first recording, and pin the same ones")
