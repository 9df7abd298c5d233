"""A run once more, one part of a step at a time, and what to look for in its arrays; for `jeuler.diagnose`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.component import replace
from jeuler.forces import Springs
from jeuler.particles._simulate import simulate
from jeuler.particles.fields import declared, name_of
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, zero_dead_slots
from jeuler.solving._scan import Solution
from jeuler.steps.explicit import Step
from jeuler.steps.stability import stability_limit


@dataclasses.dataclass(frozen=True)
class Rerun:
    """The arguments of a run."""

    scene: Scene
    state: ParticleState
    dt: float
    t0: float
    step: Step
    key: jax.Array | None

    def solution(self, num_steps: int, save_every: int | None = None) -> Solution:
        return simulate(
            self.scene,
            self.state,
            dt=self.dt,
            num_steps=num_steps,
            t0=self.t0,
            step=self.step,
            key=self.key,
            save_every=save_every or max(num_steps, 1),
        )

    def before(self, n: int) -> ParticleState:
        """The state before step n."""
        return jax.tree.map(lambda x: x[-1], self.solution(n - 1).y)

    def time(self, n: Any) -> Any:
        """The time at the start of step n."""
        return self.t0 + (n - 1) * self.dt

    def force(self, force: Any, t: Any, state: ParticleState) -> Callable:
        """One force by itself, as a function of position and velocity, with the fields of this state."""
        if state.alive is not None and hasattr(force, "among"):
            force = force.among(state.alive)
        own = {name: getattr(state, name) for name in declared(force, "reads")}
        return lambda position, velocity: force(t, position, velocity, state.mass, **own)

    def effects(self, scene: Scene, n: Any, before: ParticleState, state: ParticleState, *, early: bool) -> Iterator:
        """The state after each of the effects of step n that come before the motion, or after it, with their names."""
        dt = jnp.asarray(self.dt, state.position.dtype)
        t = jnp.asarray(self.time(n if early else n + 1), dt.dtype)
        for k, effect in enumerate(scene.effects):
            if declared(effect, "before_motion", False) == early:
                own_key = None if self.key is None else jax.random.fold_in(jax.random.fold_in(self.key, n - 1), k)
                if hasattr(effect, "over_step"):
                    state = effect.over_step(t, dt, before, state, own_key)
                else:
                    state = effect(t, dt, state, own_key)
                yield f"effects[{k}] {name_of(effect)}", state

    def parts_of_step(self, scene: Scene, n: Any, before: ParticleState) -> Iterator[tuple[str, ParticleState]]:
        """The state after each effect and after the step function of step n, with the name of what was applied."""
        dt = jnp.asarray(self.dt, before.position.dtype)
        scene, state = scene.for_step(dt), before
        for part, state in self.effects(scene, n, before, before, early=True):
            yield part, state
        before, motion = state, (state.position, state.velocity)
        t = jnp.asarray(self.time(n), dt.dtype)
        x, v = self.step(scene.vector_field, t, motion, dt, scene.attributes(before))
        state = replace(before, position=x, velocity=v)
        yield name_of(self.step), state
        moved = state
        for part, state in self.effects(scene, n, before, moved, early=False):
            yield part, state
        if state.alive is not None:
            yield "dead slots", zero_dead_slots(state)

    def limit(self) -> float:
        """The stability limit at the initial state; inf where it cannot be found."""
        motion = self.state.position, self.state.velocity
        try:
            attributes = self.scene.attributes(self.state)
            return stability_limit(self.scene.vector_field, self.t0, motion, attributes, step=self.step)
        except ValueError:
            return np.inf

    def huge(self) -> float:
        return float(jnp.finfo(self.state.position.dtype).max) ** 0.75


def lost_particles(alive: Any, *arrays: jax.Array) -> tuple[int, ...]:
    """The particles with a number that is not finite, in arrays (particle, dim); the living ones, or all for None."""
    bad = np.any([~np.isfinite(np.asarray(x)).all(axis=-1) for x in arrays], axis=0)
    return tuple(np.flatnonzero(bad if alive is None else bad & np.asarray(alive)).tolist())


def springs_among(force: Any, state: ParticleState, bad: tuple[int, ...]) -> tuple[int, ...]:
    """The springs between two particles whose force is not finite; the longest first."""
    if not isinstance(force, Springs):
        return ()
    edges, x = np.asarray(force.edges), np.asarray(state.position, np.float64)
    touched = np.flatnonzero(np.isin(edges, bad).all(axis=1))
    with np.errstate(over="ignore"):
        length = np.linalg.norm(x[edges[touched, 0]] - x[edges[touched, 1]], axis=-1)
    return tuple(touched[np.argsort(-length, kind="stable")].tolist())


def coincident(position: jax.Array, among: tuple[int, ...]) -> str:
    """Words for the first two of these particles that are at one place."""
    x = np.asarray(position)
    for a in among:
        same = [b for b in range(len(x)) if b != a and (x[b] == x[a]).all()]
        if same:
            return f", where particles {min(a, same[0])} and {max(a, same[0])} coincide"
    return ""


def largest(y: Any) -> float:
    """The largest absolute value in a pytree; 0 where there is none."""
    with np.errstate(over="ignore"):
        return float(max(np.max(np.abs(np.asarray(leaf, np.float64)), initial=0) for leaf in jax.tree.leaves(y)))
