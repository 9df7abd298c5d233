"""A run once more, one part of a step at a time, and what to look for in its arrays; for `jeuler.diagnose`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks, trees
from jeuler._core.component import Function
from jeuler._core.components import stack
from jeuler._jax import programs
from jeuler.forces import Springs
from jeuler.particles._simulate import begin, simulate
from jeuler.particles.equation import Equation
from jeuler.particles.fields import name_of
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, split_state
from jeuler.particles.step import SceneStep
from jeuler.solving._scan import Solution, no_remainder
from jeuler.steps.explicit import Step, is_explicit_of_first_order
from jeuler.steps.stability import stability_limit

GROWN = 1e3  # times what it was: then a step size may be the cause
MOST_ROUNDS = 16


@dataclasses.dataclass(frozen=True)
class Rerun:
    """A run once more: the arguments that `simulate` got, and its step, which can be looked at part by part."""

    scene: Scene
    given: ParticleState
    arguments: dict[str, Any]
    of_one: SceneStep
    state: ParticleState

    @classmethod
    def of(cls, scene: Scene, state: ParticleState, num_steps: int, **arguments: Any) -> Rerun:
        of_one, start = begin(scene, state, num_steps=num_steps, **arguments)
        return cls(scene, state, arguments, of_one, start)

    @property
    def step(self) -> Step:
        return self.of_one.step

    @property
    def dt(self) -> float:
        return float(self.of_one.grid.dt)

    def solution(self, num_steps: int, save_every: int | None = None) -> Solution:
        save_every = save_every or max(num_steps, 1)
        return simulate(self.scene, self.given, num_steps=num_steps, save_every=save_every, **self.arguments)

    def before(self, n: int) -> ParticleState:
        """The state before step n."""
        return jax.tree.map(lambda x: x[-1], self.solution(n - 1).y)

    def time(self, n: Any) -> Any:
        """The time at the start of step n."""
        return self.of_one.grid.clock(jnp.asarray(n, jnp.int32) - 1)

    def with_scene(self, scene: Scene) -> Rerun:
        """The same run of a scene with other parameters."""
        grid, key, of_one = self.of_one.grid, self.of_one.key, self.of_one
        other = SceneStep.of(scene, self.state, grid, of_one.step, key, compensated=of_one.compensated)
        return dataclasses.replace(self, scene=scene, of_one=other)

    def parts_of_step(self, n: Any, before: ParticleState) -> Iterator[tuple[str, ParticleState]]:
        """The name of each part of step n and the state after it; all of one program, as in `simulate`."""
        states = programs.call(_apply, (Function(self._parts_of_step), None, jnp.asarray(n, jnp.int32), before))
        for (_, name), state in states.items():
            yield name, state

    def _parts_of_step(self, n: jax.Array, before: ParticleState) -> dict[tuple[int, str], ParticleState]:
        parts = split_state(before)
        carried = parts, no_remainder(parts[0], self.of_one.compensated)
        after = self.of_one.parts(n - 1, self.time(n), carried)
        return {(k, name): moment.state for k, (name, moment, _) in enumerate(after)}

    def before_motion(self, n: int, state: ParticleState) -> ParticleState:
        """The state that step n moves on, after births and deaths, of the one that it starts from."""
        for name, after in self.parts_of_step(n, state):
            if name == name_of(self.step):
                break
            state = after
        return state

    def shares(self, t: Any, state: ParticleState) -> Iterator[tuple[str, jax.Array]]:
        """The name of each force of the step, and what it adds to the sum, (particle, dim)."""
        equation, motion = self.of_one.equation, (state.position, state.velocity)
        attributes, x, v = equation.moving(t, motion, self.scene.attributes(state))
        for share in equation.shares(t, x, v, attributes):
            yield share.name, stack(share.force)

    def nonfinite_paths(self, n: int, before: ParticleState) -> Iterator[tuple[str, float]]:
        """Effects that prescribe what is not finite at the start or the end of step n: name and time."""
        for k, effect in enumerate(self.scene.effects):
            if hasattr(effect, "prescribe"):
                for t in (self.time(n), self.time(n + 1)):
                    if not trees.all_finite(effect.prescribe(t, before.position.dtype)[1:]):
                        yield f"effects[{k}] {name_of(effect)}", float(t)
                        break

    def stages(self, n: int, before: ParticleState) -> Iterator[tuple[Any, ParticleState]]:
        """The times and states at which the motion of step n evaluates the forces, the first being its start.

        A method that does so in a compiled loop, as Newton's iteration does, shows its start alone.
        """
        t, start = self.time(n), (before.position, before.velocity)
        seen: list[tuple[Any, Any]] = [(t, start)]

        def field(t, motion, attributes):
            if not any(map(checks.is_traced, jax.tree.leaves((t, motion)))):
                seen.append((t, motion))
            return self.of_one.equation.vector_field(t, motion, attributes)

        self.step(field, t, start, self.of_one.grid.dt, self.scene.attributes(before))
        for t, (position, velocity) in seen:
            if trees.all_finite((position, velocity)):
                yield t, dataclasses.replace(before, position=position, velocity=velocity)

    def stability_limit(self, n: int) -> float:
        """The stability limit where the run begins or, if dt is within that, just before it grew; inf if not found."""
        limit = self._limit_at(self.of_one.grid.t0, self.state)
        if limit < self.dt:
            return limit
        last = self._before_growth(n)
        return self._limit_at(self.time(last + 1), self.before(last + 1)) if last else limit

    def _before_growth(self, n: int) -> int:
        """The last step before step n after which no number is 1,000 times what it was at the start; 0 for none."""
        arguments = self.arguments | {"save": lambda t, state: _largest_of((state.position, state.velocity))}
        sizes = np.asarray(simulate(self.scene, self.given, num_steps=n - 1, **arguments).y, float)
        return int(np.flatnonzero(sizes <= GROWN * max(1.0, sizes[0]))[-1])

    def _limit_at(self, t: Any, state: ParticleState) -> float:
        """The largest dt whose step, with its limit on drag, is stable: where that limit binds, it depends on dt."""
        dt, of_one = self.dt, self.of_one
        for _ in range(MOST_ROUNDS):
            context = dataclasses.replace(of_one.equation.context, dt=jnp.asarray(dt))

            def field(t, motion, attributes, context=context):
                of_this = dataclasses.replace(context, particles=len(motion[0]), dtype=motion[0].dtype)
                return Equation.of(self.scene.forces, self.scene.effects, of_this).vector_field(t, motion, attributes)

            try:
                motion, attributes = (state.position, state.velocity), self.scene.attributes(state)
                limit = float(stability_limit(field, t, motion, attributes, step=self.step))
            except ValueError:
                return np.inf
            limited = is_explicit_of_first_order(self.step) and any(hasattr(f, "drag") for f in self.scene.forces)
            if not limited or limit == 0 or dt == self.dt <= limit:
                return limit
            if limit >= dt * (1 - 1e-3):
                return dt
            dt = limit
        return dt

    def huge(self) -> float:
        return float(jnp.finfo(self.state.position.dtype).max) ** 0.75


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """function, by a program kept from an earlier call where there is one."""
    program = programs.prepared(_apply, (Function(function),))
    return lambda *inputs: program(None, *inputs)


def _apply(function: Callable[..., Any], _: None, *inputs: Any) -> Any:
    """function(*inputs); before these stands the one input whose memory the result would take."""
    return function(*inputs)


def nonfinite_particles(alive: Any, *arrays: jax.Array) -> tuple[int, ...]:
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


def _largest_of(y: Any) -> jax.Array:
    """The largest absolute value in a pytree, as part of a run."""
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf), initial=0) for leaf in jax.tree.leaves(y)]))


def largest(y: Any) -> float:
    """The largest absolute value in a pytree; 0 where there is none."""
    with np.errstate(over="ignore"):
        return float(max(np.max(np.abs(np.asarray(leaf, np.float64)), initial=0) for leaf in jax.tree.leaves(y)))
