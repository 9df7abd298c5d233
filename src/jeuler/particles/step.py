"""One step of a scene, part by part: effects, motion, effects, zeros in dead slots. It is composed here alone."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.calls import with_previous
from jeuler._core.component import replace
from jeuler._core.components import per_particle, split, stack
from jeuler.particles.equation import Equation
from jeuler.particles.fields import BEFORE, acts, name_of, needs
from jeuler.particles.loads import held, loads
from jeuler.particles.protocols import Context
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, join_state, split_state, zero_dead_slots
from jeuler.solving._scan import advance_by
from jeuler.solving.grid import Grid
from jeuler.steps.explicit import Step, VectorField


class Moment:
    """The state at a point within a step: whole, and in the parts in which it is carried, each made when asked for."""

    def __init__(
        self, *, state: ParticleState | None = None, parts: tuple[tuple[Any, ...], ParticleState] | None = None
    ) -> None:
        if state is not None:
            self.state = state
        if parts is not None:
            self.parts = parts

    @functools.cached_property
    def state(self) -> ParticleState:
        return join_state(self.parts)

    @functools.cached_property
    def parts(self) -> tuple[tuple[Any, ...], ParticleState]:
        return split_state(self.state)


@dataclasses.dataclass(frozen=True)
class SceneStep:
    """A step of a run of a scene. `simulate` carries its last moment on; `diagnose` looks at each."""

    scene: Scene
    grid: Grid
    step: Step
    key: Array | None
    equation: Equation
    compensated: bool = False
    any_window: bool = False  # the forces are prepared in each step, for as many particles as it has

    @classmethod
    def of(cls, scene: Scene, state: ParticleState, grid: Grid, step: Step, key: Array | None, **how: Any) -> SceneStep:
        context = Context(len(state.position), state.position.dtype, grid.dt, step)
        return cls(scene, grid, step, key, Equation.of(scene.forces, scene.effects, context), **how)

    @functools.cached_property
    def advance(self) -> Callable[..., Any]:
        contact = self.contact_in_the_solve()
        if hasattr(self.step, "increment") and contact is None:
            return advance_by(self.step, compensated=self.compensated)
        return advance_by(on_arrays(self.step, contact), compensated=self.compensated)

    def contact_in_the_solve(self) -> InTheSolve | None:
        """What puts contact at rest into the equation of a step that solves for its end; None where there is none."""
        in_the_solve = tuple(effect for effect in self.scene.effects if needs(effect, "the solve"))
        explicit = getattr(self.step, "explicit", False)
        if not in_the_solve or explicit or not getattr(self.step, "solves_contact", True):
            return None
        return InTheSolve(in_the_solve, self.with_prescribed_pinned)

    def __call__(self, n: Array, t: Array, carried: tuple[Any, Any]) -> tuple[Any, Any]:
        """What is carried, (state in parts, remainder of its sums), after the step from t, the n-th from 0."""
        *_, (_, moment, remainder) = self.parts(n, t, carried)
        return moment.parts, remainder

    def parts(self, n: Array, t: Array, carried: tuple[Any, Any]) -> Iterator[tuple[str, Moment, Any]]:
        """The name of each part of the step, and the moment after it, in their order."""
        parts, remainder = carried
        number = n if parts[1].steps is None else parts[1].steps
        before = moment = Moment(parts=parts)
        for name, effect in self.effects(n, number, early=True):
            moment = Moment(state=effect(t, self.grid.dt, before.state, moment.state))
            yield name, moment, remainder

        before, (motion, rest) = moment, moment.parts
        motion, remainder = self.advance(
            self.field, t, (motion, remainder), self.grid.dt, self.scene.attributes(moment.state)
        )
        rest = rest if rest.steps is None else replace(rest, steps=number + 1)
        moment = Moment(parts=(motion, rest))
        yield name_of(self.step), moment, remainder

        for name, effect in self.effects(n, number, early=False):
            moment = Moment(state=effect(self.grid.clock(n + 1), self.grid.dt, before.state, moment.state))
            yield name, moment, remainder
        if rest.force is not None:
            moment = Moment(state=replace(moment.state, force=self.acted(t, before.state, motion, moment.state)))
            yield "force", moment, remainder
        if self.scene.effects and rest.alive is not None:
            yield "dead slots", Moment(state=zero_dead_slots(moment.state)), remainder

    def effects(self, n: Array, number: Array, *, early: bool) -> Iterator[tuple[str, Callable[..., Any]]]:
        """Name, and ``effect(t, dt, previous, state)`` with its key, of those before the motion, or after.

        n is the number of the step in this run, ``number`` with those of the run that this one goes on from.
        """
        for k, effect in enumerate(self.scene.effects):
            if (acts(effect) == BEFORE) == early:
                key = None if self.key is None else jax.random.fold_in(jax.random.fold_in(self.key, number), k)
                act = with_its_needs(effect, key, n, self.grid.t0)
                if needs(effect, "the solve") and self.contact_in_the_solve() is not None:
                    act = functools.partial(self._with_acceleration, act)
                if needs(effect, "prescribed pinned") and self.equation.effects:
                    act = functools.partial(self._with_prescribed_pinned, act)
                yield f"effects[{k}] {name_of(effect)}", act

    def _with_acceleration(
        self, act: Callable, t: Any, dt: Any, previous: ParticleState, state: ParticleState
    ) -> ParticleState:
        """The effect, told what acceleration the forces gave at the start of the step."""
        motion, attributes = (previous.position, previous.velocity), self.scene.attributes(previous)
        _, acceleration = self.windowed(len(previous.position)).vector_field(t - dt, motion, attributes)
        return act(t, dt, previous, state, acceleration=acceleration)

    def _with_prescribed_pinned(
        self, act: Callable, t: Any, dt: Any, previous: ParticleState, state: ParticleState
    ) -> ParticleState:
        """The effect on a state in which prescribed particles have mass inf, whatever mass they have."""
        mass = jnp.broadcast_to(state.mass, (len(state.position),))
        mass = self.with_prescribed_pinned(t, mass, state.position.dtype)
        return replace(act(t, dt, previous, replace(state, mass=mass)), mass=state.mass)

    def with_prescribed_pinned(self, t: Any, mass: Array, dtype: Any) -> Array:
        """mass, (particle,), with inf for the prescribed particles."""
        for indices, *_ in self.equation.prescribed(t, dtype):
            mass = mass.at[indices].set(jnp.inf)
        return mass

    def acted(self, t: Any, before: ParticleState, motion: tuple[Any, ...], after: ParticleState) -> Array:
        """The mean force on each particle in the step from t, of the motion and of the effects after it.

        F = m (v(t + dt) - v(t)) / dt,   and for pinned and prescribed particles the sum of the forces at t
        """
        attributes = self.scene.attributes(before)
        mass = jnp.broadcast_to(before.mass, (len(before.position),))
        support = held(self.equation, t, mass, before.position.dtype)
        gained = after.velocity - before.velocity
        if hasattr(self.step, "increment") and self.contact_in_the_solve() is None:
            # not as a difference of velocities, which has lost the digits of a small one
            pushed = self.step.increment(self.field, t, split_state(before)[0], self.grid.dt, attributes)[1]
            gained = stack(pushed) + (after.velocity - stack(motion[1]))
        free = jnp.where(per_particle(support), 0, per_particle(jnp.where(support, 1, mass)) * gained / self.grid.dt)
        return jnp.where(per_particle(support), self.load(t, before, attributes), free)

    def load(self, t: Any, state: ParticleState, attributes: Any) -> Array:
        return loads(self.windowed(len(state.position)), t, (state.position, state.velocity), attributes)

    def field(self, t: Any, motion: tuple[Any, ...], attributes: Any) -> tuple[Any, ...]:
        """The equation of motion by component, as the motion is carried from step to step."""
        position, velocity = map(stack, motion)
        return tuple(map(split, self.windowed(len(position)).vector_field(t, (position, velocity), attributes)))

    def windowed(self, particles: int) -> Equation:
        """The equation for this many particles, those of a window."""
        if not self.any_window or particles == self.equation.context.particles:
            return self.equation
        context = dataclasses.replace(self.equation.context, particles=particles)
        return Equation.of(self.scene.forces, self.scene.effects, context)


def with_its_needs(effect: Any, key: Array | None, n: Any, t0: Array) -> Callable[..., Any]:
    """The effect as ``effect(t, dt, previous, state)``, with its key and, if it needs it, the clock."""
    clock = {"clock": (n, t0)} if needs(effect, "clock") else {}
    act = functools.partial(with_previous(effect, ""), key=key, **clock)

    def with_counter(t: Any, dt: Any, previous: ParticleState, state: ParticleState, **named: Any) -> Any:
        after = act(t, dt, previous, state, **named)
        forgotten = isinstance(after, ParticleState) and after.steps is None and state.steps is not None
        return replace(after, steps=state.steps) if forgotten else after  # a state made anew knows nothing of the run

    return with_counter


@dataclasses.dataclass(frozen=True)
class InTheSolve:
    """Effects that have a place in the equation of a step which solves for its end, as contact has.

    Called as ``(f, t, y, dt, attributes)``: f with them, so that v + dt f is the velocity after all forces.
    """

    effects: tuple[Any, ...]
    with_prescribed_pinned: Callable[..., Array]  # of (t, mass, dtype), the mass

    def __call__(
        self, f: VectorField, t: Any, y: Any, dt: Any, attributes: Any, touching: tuple[Any, ...] | None = None
    ) -> VectorField:
        (_, velocity), start = y, self._start(f, t, y, dt, attributes)
        stays = touching or (None,) * len(self.effects)
        answers = [effect.answer(*start, which) for effect, which in zip(self.effects, stays, strict=True)]

        def with_them(t, y, attributes):
            slope, acceleration = f(t, y, attributes)
            for answer in answers:
                acceleration = acceleration + answer(velocity + dt * acceleration) / dt
            return slope, acceleration

        return with_them

    def touching(self, f: VectorField, t: Any, y: Any, dt: Any, attributes: Any) -> tuple[Any, ...]:
        """What each of them says touches through the whole of a step from (t, y)."""
        start = self._start(f, t, y, dt, attributes)
        return tuple(effect.touching(*start) for effect in self.effects)

    def _start(self, f: VectorField, t: Any, y: Any, dt: Any, attributes: Any) -> tuple[Any, ...]:
        """Time, size of the step, state and acceleration at its start."""
        x, v = y
        mass = self.with_prescribed_pinned(t, jnp.broadcast_to(attributes.mass, (len(x),)), x.dtype)
        return t, dt, ParticleState(x, v, mass, alive=attributes.alive), f(t, y, attributes)[1]


@dataclasses.dataclass(frozen=True)
class FieldInStep:
    """A vector field on arrays that is another one within a step, see `jeuler.steps.implicit.in_step`."""

    field: VectorField
    changed: InTheSolve
    touching: tuple[Any, ...] | None = None

    def __call__(self, t: Any, y: Any, args: Any) -> Any:
        return self.field(t, y, args)

    def in_step(self, t: Any, y: Any, dt: Any, args: Any) -> VectorField:
        return self.changed(self.field, t, y, dt, args, self.touching)

    def within(self, t: Any, y: Any, dt: Any, args: Any) -> FieldInStep:
        """The field in parts of the step from (t, y)."""
        return dataclasses.replace(self, touching=self.changed.touching(self.field, t, y, dt, args))


def on_arrays(step: Step, changed: InTheSolve | None = None) -> Step:
    """A step that may do arithmetic on (particle, dim) arrays, for the motion by components.

    Within the step the vector field f is ``changed(f, t, y, dt, attributes)``, for steps that ask for it.
    """

    def by_components(f, t, motion, dt, attributes):
        def on_arrays(t, y, attributes):
            return tuple(map(stack, f(t, tuple(map(split, y)), attributes)))

        arrays = tuple(map(stack, motion))
        field = on_arrays if changed is None else FieldInStep(on_arrays, changed)
        after = step(field, t, arrays, dt, attributes)
        checks.same_form("the step", arrays, after)
        return tuple(map(split, after))

    return functools.wraps(step)(by_components)
