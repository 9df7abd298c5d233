"""What sensors read of a scene in several recordings: the residual of a fit with ``observe=`` or ``recordings=``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.component import replace
from jeuler._core.interpolate import hermite
from jeuler._jax.haste import Haste, jit_in_haste
from jeuler.fitting.forward import MEDIUM, SMALL, in_a_loop
from jeuler.fitting.parameters import Places
from jeuler.fitting.prediction import motion
from jeuler.observing import Sensor
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.solving.grid import Checkpoint
from jeuler.steps.explicit import Step

SENSOR_PARAMETERS = ("delay", "gain", "bias")


@dataclasses.dataclass(frozen=True)
class Group:
    """Recordings that one program runs side by side: of one form, filled up to the longest.

    Attributes:
      members: which of the recordings.
      num_steps: steps of the longest run.
      lengths: times of each.
      columns: of the flattened reading, those that were observed in each.
    """

    members: tuple[int, ...]
    num_steps: int
    lengths: tuple[int, ...]
    columns: tuple[tuple[int, ...], ...]


@dataclasses.dataclass(frozen=True)
class Readings:
    """Readings at the times of recordings, and the residual against them. Hashable: programs are kept by it.

    Attributes:
      places: what of scene and state is fitted.
      of_sensor: which of delay, gain and bias are.
      own: the parameters of which each recording has its own value, along a leading axis.
      periods: of readings that are angles, of each group; None of others.
      numbers: that all runs of a Jacobian pass through, about.
    """

    places: Places
    of_sensor: tuple[str, ...]
    own: tuple[str, ...]
    step: Step
    groups: tuple[Group, ...]
    periods: tuple[float | None, ...]
    numbers: int
    checkpoint: Checkpoint = None

    @property
    def haste(self) -> Haste:
        """How hastily its programs are compiled: runs that are short are not worth the compiler's work."""
        return "great" if self.numbers <= SMALL else "some" if self.numbers <= MEDIUM else "none"

    def form(self, data: Sequence[dict[str, Any]]) -> tuple[jax.ShapeDtypeStruct, ...]:
        """The form of the residual."""
        found = {
            member: jax.ShapeDtypeStruct((length, len(columns)), own["state"].position.dtype)
            for group, own in zip(self.groups, data, strict=True)
            for member, length, columns in zip(group.members, group.lengths, group.columns, strict=True)
        }
        return tuple(found[member] for member in range(len(found)))

    def readings(self, params: dict[str, Any], data: Sequence[dict[str, Any]]) -> list[Array]:
        """What each group reads, (recording, time, ...)."""
        found = []
        for group, own_data in zip(self.groups, data, strict=True):
            members = np.asarray(group.members)
            own = {name: jax.tree.map(lambda x, at=members: x[at], params[name]) for name in self.own}
            shared = {name: value for name, value in params.items() if name not in self.own}

            def one(own: Any, each: Any, shared: Any = shared, group: Group = group) -> Array:
                return self._of_one({**shared, **own}, each, group.num_steps)

            if len(members) == 1:
                first = jax.tree.map(lambda x: x[0], (own, own_data))
                found.append(one(*first)[None])
            else:
                found.append(jax.vmap(one)(own, own_data))
        return found

    def _of_one(self, params: dict[str, Any], data: dict[str, Any], num_steps: int) -> Array:
        """The readings of one recording, (time, ...)."""
        scene, state = self.places.put(data["scene"], data["state"], params)
        sensor = replace(data["sensor"], **{name: params[name] for name in self.of_sensor})
        how: dict[str, Any] = {"num_steps": num_steps, "step": in_a_loop(self.step), "checkpoint": self.checkpoint}
        moved = motion(scene, state, dt=data["dt"], t0=data["t0"], key=data["key"], **how)
        return read(sensor, scene, state, moved, data, num_steps)

    def __call__(self, params: dict[str, Any], data: Sequence[dict[str, Any]]) -> tuple[Array, ...]:
        """Reading minus measurement where something was observed, 0 elsewhere, (time, column), of each recording."""
        found: dict[int, Array] = {}
        for group, period, own, read in zip(self.groups, self.periods, data, self.readings(params, data), strict=True):
            for k, member in enumerate(group.members):
                count, columns = group.lengths[k], np.asarray(group.columns[k], int)
                seen = read[k, :count].reshape(count, -1)[:, columns]
                off = seen - own["targets"][k, :count][:, columns].astype(seen.dtype)
                off = off if period is None else off - period * jnp.round(off / period)
                found[member] = jnp.where(own["observed"][k, :count][:, columns], off, 0)
        return tuple(found[member] for member in range(len(found)))


def read(
    sensor: Sensor, scene: Scene, state: ParticleState, run: tuple[Array, Array], data: dict[str, Any], num_steps: int
) -> Array:
    """What a sensor reads at the times of a recording, from positions and velocities at the steps of a run.

    Between steps both are cubic Hermite interpolants, the velocity with the accelerations at the ends of its step.
    """
    p, v = run
    dtype, dt = p.dtype, data["dt"]
    later = data["fraction"] - sensor.delay / dt
    interval = jnp.clip(data["interval"] + jnp.floor(later).astype(int), 0, num_steps - 1)
    s = later - (interval - data["interval"])
    t = data["t0"] + (interval + s) * dt
    moving, mass = scene.without_effects(), scene.attributes(state)

    def slope(k: Array) -> Array:
        at = (data["t0"] + k * dt).astype(dtype)
        return jax.vmap(lambda t, p, v: moving.vector_field(t, (p, v), mass)[1])(at, p[k], v[k])

    part, width = s.astype(dtype)[:, None, None], dt.astype(dtype)
    position = hermite(part, width, p[interval], p[interval + 1], v[interval], v[interval + 1])
    velocity = hermite(part, width, v[interval], v[interval + 1], slope(interval), slope(interval + 1))

    def at_time(t: Array, p: Array, v: Array) -> Array:
        return jnp.asarray(sensor(t, scene, replace(state, position=p, velocity=v)))

    return jax.vmap(at_time)(t.astype(dtype), position, velocity)


@functools.lru_cache(maxsize=32)
def compiled_residual(readings: Readings) -> Callable[..., Any]:
    """The residual, compiled once for recordings of one form."""
    return jit_in_haste(readings, readings.haste)


@functools.lru_cache(maxsize=32)
def compiled_readings(readings: Readings) -> Callable[..., Any]:
    """The readings of each group, compiled once for recordings of one form."""
    return jit_in_haste(readings.readings, readings.haste)
