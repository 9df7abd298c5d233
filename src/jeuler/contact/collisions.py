"""Collisions of particles with colliders and of chosen particles with each other, at their time of impact."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import ColliderLike, Parameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler.contact.colliders import as_collider, check_collider
from jeuler.contact.contacts import Contacts
from jeuler.contact.within_step import answer, at_start_of_fall, resolve

FEW_PAIRS = 32  # of them, XLA's faster loops do not pay for their compilation, and many rounds do not take long


@component(static=("pairs", "max_bounces", "capacity"), positive=("radius", "restitution", "friction"))
class Collisions:
    """Contact with restitution and Coulomb friction, resolved where on its way a particle meets the surface.

        at gap = 0:   v_n -> -restitution v_n,   |change of v_t| <= friction |change of v_n|

    Impacts are found at their time within the step and followed one after the other, as many as there are; the rest of
    the step is travelled with the new velocity, so that values and gradients through a bounce are those of the exact
    motion, and a thin obstacle is not missed. What touches at the start of a step and does not come together faster
    than the forces of one step, or the speed that a surface gains in it, can make it rests: contact forces hold it
    through the step, stacks and piles too.
    Overlaps of what rests are closed by displacements. What could not be resolved is counted in
    ``Solution.unresolved_contacts``. Beside the library's implicit steps what rests is part of the solve. Particles do
    not collide with each other unless ``pairs`` says so. Pinned particles (mass = inf) and prescribed ones are never
    moved. Where a signed distance is NaN, so is the particle.

    Args:
      colliders: `Plane`, `Sphere`, `Box`, or any signed distance ``(t, point) -> ()``; a tuple.
      pairs: the pairs (i, j) of particles that collide as balls, integers (pair, 2); "near" for all that come within
        reach of each other, found at each step. Static.
      radius: of each particle, () or (particle,), m. Differentiable.
      restitution: 1 elastic, 0 no bounce, (). Differentiable.
      friction: Coulomb's coefficient, (). Differentiable.
      max_bounces: rounds of impacts that are followed within one step, those that come at once in different places in
        one; None: 8, with pairs 32, and with up to 32 pairs 191, as plastic impacts in a row leave a part of the speed
        each time. What is left is counted. Static.
      capacity: with "near", the most balls that may be within the reach of one in a step, 2 max(radius) and four times
        the longest way; None: 24, enough for balls of like size. Those beyond it are counted too. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state at the end of the step. Without
      ``previous``, the state before the step is taken to be the one from which this velocity leads to this position.
    Raises: ValueError, if a value is out of its range; in `simulate`, if an index or a shape does not fit.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> balls = jeuler.ParticleState([[0.0], [0.52]], [[1.0], [0.0]])
      >>> elastic = jeuler.Collisions(pairs=[(0, 1)], radius=0.1, restitution=1.0)
      >>> end = jeuler.simulate(jeuler.Scene(effects=(elastic,)), balls, dt=0.25, num_steps=4)
      >>> [round(x, 5) for x in end.y.position[-1, :, 0].tolist()]
      [0.32, 1.2]

    Source: B. Mirtich, Impulse-based Dynamic Simulation of Rigid Body Systems, 1996, ch. 3; gradients: Y. Hu et al.,
      DiffTaichi, ICLR 2020, sect. 4 (time of impact); rest: M. Anitescu, F. A. Potra, Formulating Dynamic Multi-Rigid-
      Body Contact Problems with Friction as Solvable Linear Complementarity Problems, Nonlinear Dynamics 14, 1997.
    """

    colliders: tuple[ColliderLike, ...] = ()
    pairs: tuple[tuple[int, int], ...] | Literal["near"] = ()
    radius: Parameter = default(0.0)
    restitution: Parameter = default(0.0)
    friction: Parameter = default(0.0)
    max_bounces: int | None = None
    capacity: int | None = None

    needs: ClassVar[tuple[str, ...]] = ("forward time", "prescribed pinned", "the solve")
    axis: ClassVar[str | None] = None  # of the devices that share the particles

    def __post_init__(self) -> None:
        if not isinstance(self.colliders, (tuple, list)):
            raise ValueError(
                f"Collisions.colliders must be a tuple, got {type(self.colliders).__name__}; write (collider,)"
            )
        colliders = tuple(as_collider(f"Collisions.colliders[{k}]", c) for k, c in enumerate(self.colliders))
        object.__setattr__(self, "colliders", colliders)
        object.__setattr__(self, "pairs", _pairs(self.pairs))
        if self.max_bounces is not None:
            checks.count("Collisions.max_bounces", self.max_bounces, least=1)
        if self.capacity is not None:
            checks.count("Collisions.capacity", self.capacity, least=1)
            if self.pairs != "near":
                raise ValueError(
                    'Collisions.capacity is of pairs="near" alone, got pairs by their indices; leave it out'
                )
        store_as_float(self, "radius", "restitution", "friction")
        for name, most in (("radius", np.inf), ("restitution", 1.0), ("friction", np.inf)):
            value = getattr(self, name)
            # by NumPy, as jax.numpy is traced where the scene is made inside of jit
            if not checks.is_traced(value) and not np.all((np.asarray(value) >= 0) & (np.asarray(value) <= most)):
                raise ValueError(f"Collisions.{name} must be from 0 to {most}, got {checks.shown(value.tolist())}")
        for name in ("radius", "friction"):
            checks.finite(f"Collisions.{name}", getattr(self, name))

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any, *, acceleration: Any = None) -> Any:
        if not self.colliders and not self.pairs:
            return state
        if previous is None:
            previous = dataclasses.replace(state, position=state.position - dt * state.velocity)
        x, v = previous.position, previous.velocity
        contacts = self._contacts(t - dt, dt, dataclasses.replace(state, position=x))
        position, velocity, unresolved = resolve(
            contacts, x, v, state.position, state.velocity, self._rounds(), acceleration=acceleration
        )
        before = state.unresolved_contacts
        count = before if before is None else before + unresolved
        return dataclasses.replace(state, position=position, velocity=velocity, unresolved_contacts=count)

    def answer(
        self, t: Any, dt: Any, state: Any, acceleration: Array, stays: Array | None = None
    ) -> Callable[[Array], Array]:
        """What contacts at rest add to the velocities at the end of a step from this state, given these velocities.

        A part of a step is told who ``stays`` in touch, (contact,): what is `touching` at the start of the whole.
        """
        if not self.colliders and not self.pairs:
            return jnp.zeros_like
        return answer(self._contacts(t, dt, state), state.position, state.velocity, acceleration, stays)

    def touching(self, t: Any, dt: Any, state: Any, acceleration: Array) -> Array | None:
        """Who touches at the start of a step from this state and does not bounce, (contact,).

        It stays in touch in all parts of the step, so that they differ by their length alone. None where each part has
        a list of contacts of its own.
        """
        contacts = self._contacts(t, dt, state)
        if not contacts.count or not contacts.follows_all:
            return None
        return at_start_of_fall(contacts, state.position, state.velocity, acceleration)[-1]

    def _contacts(self, t: Any, dt: Any, state: Any) -> Contacts:
        return Contacts(self, jnp.asarray(t), jnp.asarray(dt), state.position, state.mass, state.alive)

    @property
    def writes(self) -> tuple[str, ...]:
        return ("unresolved_contacts",)

    def is_long_code(self, particles: int) -> bool:
        """Whether compiling a run takes longer than it runs: contacts that may be several at once, and not many."""
        pairs = particles if self.pairs == "near" else len(self.pairs)
        return (len(self.colliders) > 1 or pairs > 0) and pairs <= FEW_PAIRS

    def _rounds(self) -> int:
        if self.max_bounces is not None:
            return self.max_bounces
        if not self.pairs:
            return 8
        return 32 if self.pairs == "near" or len(self.pairs) > FEW_PAIRS else 191

    def check(self, particles: int, dim: int) -> None:
        for i, j in () if self.pairs == "near" else self.pairs:
            if max(i, j) >= particles:
                raise ValueError(f"Collisions.pairs must be indices below {particles}, got ({i}, {j})")
        for name, shapes in (("radius", ((), (particles,))), ("restitution", ((),)), ("friction", ((),))):
            checks.shape(f"Collisions.{name}", getattr(self, name).shape, *shapes)
        for collider in self.colliders:
            check_collider(collider, dim)


def has_long_code(effects: Sequence[Any], particles: int) -> bool:
    """Whether a run with these effects takes longer to compile than to run, by its contacts."""
    return any(effect.is_long_code(particles) for effect in effects if isinstance(effect, Collisions))


def _pairs(pairs: Any) -> tuple[tuple[int, int], ...] | Literal["near"]:
    if isinstance(pairs, str) and pairs == "near":
        return "near"
    array = checks.integers("Collisions.pairs", pairs, 'integers of shape (pair, 2), or "near"')
    if array.size == 0:
        return ()
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"Collisions.pairs must be integers of shape (pair, 2), got {array.shape}")
    checks.different("Collisions.pairs", array, "particles")
    if len(np.unique(np.sort(array, axis=1), axis=0)) < len(array):
        raise ValueError("Collisions.pairs must name each pair once, got one twice; drop what is repeated")
    return tuple((int(i), int(j)) for i, j in array)
