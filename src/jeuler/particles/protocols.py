"""What a component may do: every hook of forces, effects, airs, colliders and samplers, and when it is called.

A component is a function, or a class made with `jeuler._core.component.component`, of the signature of its kind. What
else it has of the methods and attributes below is found and used; all of them may be left out.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

from jax import Array

from jeuler.forces.drag import Resistance
from jeuler.particles.fields import Acts, Need
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import Step


@dataclasses.dataclass(frozen=True)
class Context:
    """What is known of a run where a force prepares for it.

    Attributes:
      particles: their number; that of a window, where the run works on a part of the slots.
      dtype: of position and velocity.
      dt: size of the step, s; None outside of a run, as in `solve(scene.vector_field, ...)`.
      step: the method; None outside of a run.
      alive: (particle,), who lives; None before the first step, and where no particle is born or dies.
      limits_drag: whether drags are limited in this step, so that the sum of the other forces is read more than once.
    """

    particles: int
    dtype: Any
    dt: Array | None = None
    step: Step | None = None
    alive: Array | None = None
    limits_drag: bool = False


class Force(Protocol):
    """``force(t, position, velocity, mass)``: the force on each particle, (particle, dim), N.

    Position and velocity are (particle, dim), mass is (particle,). A pinned particle has mass inf, and so has a dead
    slot. Fields that the force ``reads`` follow as keywords.
    """

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, **fields: Array) -> Array: ...


class Effect(Protocol):
    """``effect(t, dt, previous, state, key)``: the state with the effect done to it, at each step.

    Effects act in the order written. Before the motion t is the time at the start of the step and previous the state
    there. After it, t is the time at the end, and previous the state right before the motion. The key is its own at
    each step, or None if `simulate` got none. A function ``(t, dt, state, key)`` does as well.
    """

    def __call__(self, t: Any, dt: Any, previous: ParticleState, state: ParticleState, key: Any) -> ParticleState: ...


class Air(Protocol):
    """``air(t, position)``: the velocity of the air at each particle, (particle, dim), m/s."""

    def __call__(self, t: Any, position: Array) -> Array: ...


class Collider(Protocol):
    """``collider(t, point)``: the signed distance of one point (dim,), (), m; negative inside the solid."""

    def __call__(self, t: Any, point: Array) -> Array: ...


class Sampler(Protocol):
    """``sampler(key, count)``: the values of count newborns, (count, ...)."""

    def __call__(self, key: Array, count: int) -> Array: ...


class ForceHooks(Force, Protocol):
    """What a force may have beside its call."""

    reads: tuple[str, ...]
    """Fields of the state, beside position, velocity and mass, that it gets as keywords."""

    def prepare(self, context: Context) -> Force | None:
        """The force in the form that the loop calls, with the work done that is the same at every step.

        Called before the loop; where particles are born or die, again at each step, on what it returned before, with
        ``context.alive``. None where there is nothing to do.
        """

    def drag(self, t: Any, position: Array) -> Resistance:
        """What a drag is made of, if the whole force is -(c + q |u|) u: `simulate` does not let it overshoot.

        Called in place of the force, by explicit first-order steps alone.
        """

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy, (), J. Called by `Scene.energy`."""

    def check(self, particles: int, dim: int) -> None:
        """ValueError if it does not fit so many particles. Called by `simulate`, before tracing; of effects too."""


class EffectHooks(Effect, Protocol):
    """What an effect may have beside its call, and ``check``, as forces have it."""

    acts: Acts
    """When in a step; "start and after motion" is once before the first step, with dt = 0, as well. Default: after."""

    reads: tuple[str, ...]
    """Fields that must be in the state."""

    writes: tuple[str, ...] | dict[str, Any]
    """Fields that it changes for some particles: the state gets them if it has none. A dictionary says the shape of
    one particle's value of fields that are not the library's own, or has a `FieldForm` for one of another type."""

    sets: tuple[str, ...] | dict[str, tuple[int, ...]]
    """Fields that it gives to every particle at each step: no other effect may write them."""

    needs: tuple[Need, ...]
    """What it cannot do without: "key", for random numbers; "clock", ``clock=(n, t0)`` in place of a keyword's default,
    n the steps taken before this one; "forward time", dt > 0; "prescribed pinned", mass inf of prescribed particles as
    of pinned ones; "the solve", a place in the equation of steps that solve for their end: ``answer(t, dt, state,
    acceleration, stays)``, of the state at the start and the acceleration there, gives a function of the velocities at
    the end, (particle, dim), to what is added to them; ``stays`` is None, or in a part of a step what ``touching(t, dt,
    state, acceleration)`` said at the start of the whole. Beside such steps the call gets ``acceleration=`` in place of
    a keyword's default. And a place among the other effects: "the events", before the motion after those that let
    particles die and before births into their slots, after the motion after `Collisions`; "the last place", after all
    that act after the motion."""

    max_births: int | None
    """The most births in a step, None for no limit: windows must hold them."""

    def prescribe(self, t: Any, dtype: Any) -> tuple[Any, Array, Array, Array]:
        """Indices of particles, and their position, velocity and acceleration, each (index, dim), whatever the forces.

        Called wherever the equation of motion is, at each of its times.
        """

    def check(self, particles: int, dim: int) -> None:
        """ValueError if it does not fit so many particles. Called by `simulate`, before tracing."""


class ColliderHooks(Collider, Protocol):
    """What a collider may have beside its call."""

    def check(self, dim: int) -> None:
        """ValueError if it does not fit points of this dimension. Called before tracing by what holds the collider."""


class SamplerHooks(Sampler, Protocol):
    """What a sampler may have in place of its call, so that all samplers of an emitter share their random numbers."""

    numbers: int
    """How many uniform numbers a newborn takes."""

    def at(self, u: Array) -> Array:
        """The values for uniform numbers u, (numbers, count), in [0, 1). Called at each step."""


HOOKS = (
    "acts", "at", "check", "drag", "energy", "max_births", "needs", "numbers", "prepare", "prescribe", "reads", "sets",
    "writes",
)  # fmt: skip
