"""One recording of several, and what it is once it is checked."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.component import replace, result
from jeuler.fitting.observations import checked_observations, place_in_steps
from jeuler.fitting.series import column_names
from jeuler.observing import Sensor
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState


@result
class Recording:
    """One recording for ``fit_springs(recordings=[...])``: what was measured, and what is its own.

    Args:
      times: when it was measured, (time,), s; not decreasing, on any grid, from t0 on.
      values: what was measured, (time, ...) as the observation shows it; axes of length one may be left out. NaN = not
        observed.
      state: the state at t0, with the starting values of what is fitted; None takes that of the fit.
      scene: with what acted in this recording alone, such as its own measured input; of the same forces and effects as
        that of the fit. Its parameters that are fitted are those of the fit. None takes that of the fit.
      t0: time of the state, s; None takes that of the fit.
      observe: what was measured; None takes that of the fit.
      sigma, weights: as in `fit_springs`, broadcast to values; None takes those of the fit.
    Example:
      >>> import numpy as np, jeuler
      >>> swing = jeuler.Recording(np.linspace(0.0, 1.0, 11), np.zeros((11, 1, 2)), sigma=0.01)
      >>> swing.sigma
      0.01
    """

    times: Any
    values: Any
    state: ParticleState | None = None
    scene: Scene | None = None
    t0: float | None = None
    observe: Any = None
    sigma: Any = None
    weights: Any = None


@dataclasses.dataclass(frozen=True)
class Checked:
    """A recording with all that it needs.

    Attributes:
      where: what messages call it: "" or "recordings[2].".
      times: (time,), s.  targets: (time, ...), NaN where not observed.  shape: of one reading.
      sigma, weights: (time, ...), or None.
      left_out: times that a late sensor shows before the run begins.
      num_steps: that reach the last time.
    """

    where: str
    scene: Scene
    state: ParticleState
    sensor: Sensor
    times: np.ndarray
    targets: Any
    t0: float
    sigma: Any
    weights: Any
    left_out: np.ndarray
    num_steps: int

    @classmethod
    def of(cls, given: Recording, where: str, dt: float, late: tuple[float, float] | None) -> Checked:
        """From a recording with nothing left open, or one ValueError; ``late``: bounds of a delay that is fitted."""
        scene, state, sensor = given.scene, given.state, given.observe
        checks.kind(f"{where}state", state, ParticleState)
        checks.kind(f"{where}scene", scene, Scene)
        checks.number(f"{where}t0", given.t0)
        assert isinstance(scene, Scene)  # for the type checker: it was looked at above
        assert isinstance(state, ParticleState)
        t0 = float(given.t0 or 0.0)
        state.check()
        scene.check(state)
        for name, value in (("times", given.times), ("state.mass", state.mass), ("observe.delay", sensor.delay)):
            if checks.is_traced(value):
                raise ValueError(f"{where}{name} must be a value, got a traced one; only values and parameters are")
        sensor.check(scene, *state.position.shape)
        shape = reading_shape(sensor, scene, state)
        name = f"{where}values" if where else "positions"
        values = checks.reals(name, given.values, "numbers of shape (time, ...)")
        values = with_axes(values, shape)
        meaning = "(time, particle, dim)" if not where and len(shape) == 2 else "(time, ...), one reading a time,"
        times, targets = checked_observations(given.times, values, shape, t0, name, meaning)
        earliest, latest = late if late is not None else (float(sensor.delay),) * 2
        needed = int(np.ceil((times[-1] - earliest - t0) / dt * (1 - 1e-12)))
        left_out = times - latest < t0 - 1e-9 * dt
        if left_out.all():
            raise ValueError(
                f"{where}times must reach beyond the largest delay, {latest:g} s after t0 = {t0:g} s, got none later; "
                f'bound it closer, bounds={{"delay": (0, ...)}}'
            )
        sigma, weights = (spread(where, n, getattr(given, n), targets.shape) for n in ("sigma", "weights"))
        return cls(
            where,
            scene,
            state,
            sensor,
            times,
            targets,
            t0,
            sigma,
            weights,
            left_out,
            max(1, needed),
        )

    @property
    def size(self) -> int:
        """How many numbers one reading has."""
        return math.prod(self.targets.shape[1:])

    @property
    def columns(self) -> tuple[int, ...]:
        """Of the flattened reading, those that were observed at some time."""
        if checks.is_traced(self.targets):
            return tuple(range(self.size))
        return tuple(np.flatnonzero(self.seen.any(axis=0)).tolist())

    @property
    def flat(self) -> Any:
        """The measurement, (time, number)."""
        return self.targets.reshape(len(self.times), -1)

    @property
    def seen(self) -> Any:
        """What was observed and is fitted, (time, number)."""
        xp: Any = jnp if checks.is_traced(self.targets) else np
        return xp.isfinite(self.flat) & ~self.left_out[:, None]

    def shown_as(self, gain: bool) -> tuple[str, str, tuple[str, ...]]:
        """Quantity, unit and names of the numbers; of a sensor with a gain, given or fitted, in a unit of its own."""
        observed = self.sensor.observation
        particles = getattr(observed, "particles", None)
        names = column_names(observed.quantity, self.targets.shape[1:], None if particles is None else particles[:])
        if gain or np.any(np.asarray(self.sensor.gain) != 1):
            return f"reading of {observed.quantity}", "", tuple(names)
        return observed.quantity, observed.unit, tuple(names)

    def data(self, dt: float, num_steps: int, count: int) -> dict[str, Any]:
        """What the compiled programs take, filled up to a number of times."""
        interval, fraction = place_in_steps(self.times, self.t0, dt, max(num_steps, self.num_steps))
        fill = count - len(self.times)
        xp: Any = jnp if checks.is_traced(self.targets) else np
        return {
            "scene": self.scene,
            "state": self.state,
            "sensor": self.sensor,
            "dt": np.asarray(dt, float),
            "t0": np.asarray(self.t0, float),
            "interval": np.pad(interval, (0, fill), mode="edge"),
            "fraction": np.pad(fraction, (0, fill), mode="edge"),
            "targets": xp.pad(xp.where(self.seen, self.flat, 0), ((0, fill), (0, 0))),
            "observed": xp.pad(self.seen, ((0, fill), (0, 0))),
        }


def reading_shape(sensor: Sensor, scene: Scene, state: ParticleState) -> tuple[int, ...]:
    """The shape of what a sensor shows of one state, or one ValueError where it shows no array."""
    at = jnp.zeros((), state.position.dtype)
    try:
        shown = jax.eval_shape(lambda scene, state: sensor(at, scene, state), scene, state)
    except (TypeError, AttributeError, IndexError) as error:
        raise ValueError(
            f"observe must be a function of (scene, state) or (t, state) that returns one array; it fails: {error}"
        ) from None
    return tuple(shown.shape)


def with_axes(values: Any, shape: tuple[int, ...]) -> Any:
    """Values with the axes of length one that were left out."""
    if (
        values.ndim
        and values.shape[1:] != shape
        and [n for n in values.shape[1:] if n != 1] == [n for n in shape if n != 1]
    ):
        return values.reshape(len(values), *shape)
    return values


def spread(where: str, name: str, x: Any, shape: tuple[int, ...]) -> Any:
    """Errors or weights, one for each value; None where there are none."""
    if x is None:
        return None
    xp: Any = jnp if checks.is_traced(x) else np
    try:
        given = with_axes(xp.asarray(x, float), shape[1:]) if np.ndim(x) else xp.asarray(x, float)
        return xp.broadcast_to(given, shape)
    except (ValueError, TypeError):
        raise ValueError(
            f"{where}{name} must broadcast to the measured values, {shape}, got shape {np.shape(x)}"
        ) from None


def listed(recordings: Any, times: Any, values: Any) -> list[Recording]:
    """Several recordings as a list, or one ValueError."""
    if times is not None or values is not None:
        raise ValueError("times and positions must be left out with recordings=..., each of which has its own")
    if not isinstance(recordings, (list, tuple)) or not recordings:
        raise ValueError(f"recordings must be a list of jeuler.Recording, got {checks.shown(recordings)}")
    for each in recordings:
        checks.kind("each of recordings", each, Recording)
    return list(recordings)


def completed(given: Any, scene: Scene, state: Any, t0: float, observe: Any, sigma: Any, weights: Any) -> Recording:
    """A recording with what it leaves open taken from the fit."""
    checks.kind("each of recordings", given, Recording)
    own = {"scene": scene, "state": state, "t0": t0, "observe": observe}
    filled: dict[str, Any] = {name: value for name, value in own.items() if getattr(given, name) is None}
    if given.sigma is None and given.weights is None:
        filled |= {"sigma": sigma, "weights": weights}
    return replace(given, **filled)
