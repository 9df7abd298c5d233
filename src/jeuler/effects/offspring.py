"""Births that other particles bring about: where they die, or where they touch a surface."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.annotations import OptionalCollider, Parameter, SampledParameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import Limits, check_limits
from jeuler.contact.colliders import as_collider, check_collider
from jeuler.effects.pool import (
    check_sampled_vectors,
    fields_of_births,
    first_free,
    most_births,
    put_newborns,
    samplers_of,
    store_samplers,
)  # fmt: skip
from jeuler.particles.fields import AFTER, BEFORE
from jeuler.particles.state import FieldForm
from jeuler.samplers.base import draw_named

ROUNDINGS = 8  # units in the last place of the coordinates and of the way of a step, within which it is at a surface


@component(static=("births", "inherits", "generations", "max_births"))
class SubEmitter:
    """Births where particles die, or touch a surface: the sparks of a rocket, the splash of a drop, dust of a foot.

        at each death, or contact:  births newborns at  p + position,  with velocity  inherit v + velocity

    p and v are those of the particle that dies or touches. Without ``contact``, births are in the step in which another
    effect lets a particle die, and stand in Scene.effects after those effects and before any `Emitter` that would fill
    its slot; newborns get slots that were free before. With it, births come after the motion of a step in which a
    particle comes to the surface faster than ``slowest``: it is within the margin at the end, or was turned back in the
    step, less than a step and a half's way from it. One that is within the margin before the motion is there already
    and has none, be it at rest, touching at the start, or on its way in. The derivative by what decides births,
    where and when, is 0; places and velocities of newborns have that by those of p and v.

    A birth that finds no free slot, or goes beyond ``max_births``, or is due to a particle that is not finite, is
    counted in ``state.missed_births``; all that take place are counted in ``state.births``.

    Args:
      births: their number at each death or contact, an integer >= 1. Static.
      velocity: a sampler such as `Cone` or `Normal`, or one vector (dim,), m/s.
      position: from where the particle is, a sampler such as `FromSphere`, or one vector (dim,), m; None for none.
      inherit: the share of the particle's velocity that newborns have beside their own, ().
      contact: None for births at deaths, or a collider as `Collisions` takes it, for births at contact.
      margin: (), m, how near is contact: the radius, where the particles are balls.
      slowest: (), m/s, >= 0, the lowest speed towards the surface at which contact has births: what rests has none.
      lifetime, mass, color, opacity, size, shape, extra: what newborns get, as those of an `Emitter`.
      inherits: names of fields that newborns have from their particle, such as ("color",). Static.
      generations: particles of an `Emitter` and those at the start are of generation 0, newborns of the next after
        their particle's (``state.generation``); those of this generation have no births, an integer >= 1. Static.
      max_births: the most births in one step, an integer; fewer draws cost less. None allows the whole pool. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with the births.
    Raises: ValueError, if births or generations is below 1, slowest is negative, or the contact is no collider; in
      `simulate`, if it got no key, a sampler's shape does not fit, or the order of the effects would hide deaths or
      contacts.
    Example:
      >>> import jax, jax.numpy as jnp, jeuler
      >>> sparks = jeuler.SubEmitter(20, velocity=jeuler.Normal([0.0, 0.0], 2.0), inherit=0.5)
      >>> scene = jeuler.Scene((jeuler.Gravity([0.0, -9.81]),), (jeuler.Lifetime(0.5), sparks))
      >>> rocket = jeuler.ParticleState(
      ...     jnp.zeros((30, 2)), jnp.zeros((30, 2)).at[0].set([0.0, 9.0]), alive=jnp.arange(30) == 0)
      >>> end = jeuler.simulate(scene, rocket, dt=0.1, num_steps=7, key=jax.random.key(0))
      >>> end.y.alive.sum(axis=1).tolist()
      [1, 1, 1, 1, 1, 1, 20, 20]

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983,
      sect. 2.6 (particle hierarchy).
    """

    births: int
    velocity: SampledParameter
    position: SampledParameter = default(None)
    inherit: Parameter = default(0.0)
    contact: OptionalCollider = default(None)
    margin: Parameter = default(0.0)
    slowest: Parameter = default(0.01)
    lifetime: SampledParameter = default(None)
    mass: SampledParameter = default(None)
    color: SampledParameter = default(None)
    opacity: SampledParameter = default(None)
    size: SampledParameter = default(None)
    shape: SampledParameter = default(None)
    extra: dict[str, Any] | None = None
    inherits: tuple[str, ...] = ()
    generations: int = 1
    max_births: int | None = None

    needs: ClassVar[tuple[str, ...]] = ("key", "forward time", "the events")
    limits: ClassVar[Limits] = {"inherit": ("", ""), "margin": ("", "m"), "slowest": (">= 0", "m/s")}

    def __post_init__(self) -> None:
        for name in ("births", "generations"):
            object.__setattr__(self, name, checks.count(f"SubEmitter.{name}", getattr(self, name), least=1))
        if isinstance(self.inherits, str) or not all(isinstance(name, str) for name in self.inherits):
            raise ValueError(
                f"SubEmitter.inherits must be a tuple of names of fields, got {checks.shown(self.inherits)}; "
                f'write inherits=("color",)'
            )
        object.__setattr__(self, "inherits", tuple(self.inherits))
        if self.contact is not None:
            object.__setattr__(self, "contact", as_collider("SubEmitter.contact", self.contact))
        store_as_float(self, "inherit", "margin", "slowest")
        store_samplers(self, "velocity")
        check_limits(self)

    @property
    def acts(self) -> str:
        return BEFORE if self.contact is None else AFTER

    @property
    def reads(self) -> tuple[str, ...]:
        return self.inherits

    @property
    def writes(self) -> dict[str, Any]:
        return {**fields_of_births(self), "generation": FieldForm((), 0)}

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Array) -> Any:
        previous = state if previous is None else previous
        block = most_births(self, len(state.position))
        died = previous.alive & ~state.alive
        of = died if self.contact is None else self._contacts(t, dt, previous, state)
        of = of & (state.generation < self.generations)
        wanted = self.births * jnp.sum(of, dtype=jnp.int32)
        of = of & jnp.all(jnp.isfinite(state.position) & jnp.isfinite(state.velocity), axis=1)
        parent = jnp.nonzero(of, size=-(-block // self.births), fill_value=0)[0].repeat(self.births)[:block]
        slot, free = first_free(state.alive | previous.alive, block)
        births = jnp.minimum(self.births * jnp.sum(of, dtype=jnp.int32), jnp.minimum(free, block))

        named = {"velocity": self.velocity, **samplers_of(self)}
        named |= {} if self.position is None else {"position": self.position}
        values = {name: getattr(state, name)[parent] for name in self.inherits}
        values |= draw_named(named, key, block, trees.time_dtype(state.position))
        values["position"] = state.position[parent] + values.get("position", 0)
        values["velocity"] = values["velocity"] + self.inherit * state.velocity[parent]
        values["generation"] = state.generation[parent] + 1
        return put_newborns(self, state, slot, births, wanted, values)

    def _contacts(self, t: Any, dt: Any, previous: Any, state: Any) -> Array:
        """Who came to the surface in the step: within the margin at its end, or turned back on the way.

        A particle that turned back at the surface was (distance - margin) / speed away in time, before and after: a
        step in all. What rounding can make of a distance is none: else it would decide whether one that stays counts.
        """

        def rounding(of, velocity):
            sizes = jnp.abs(of.position) + jnp.abs(velocity * dt.astype(velocity.dtype))
            return ROUNDINGS * jnp.finfo(sizes.dtype).eps * jnp.max(lax.stop_gradient(sizes), axis=-1)

        def distance_and_its_rate(time, of):
            def rate(point, velocity):
                return jax.jvp(self.contact, (time, point), (jnp.ones_like(time), velocity))

            distance, rate_of = jax.vmap(rate)(lax.stop_gradient(of.position), lax.stop_gradient(of.velocity))
            return distance - self.margin, rate_of

        t = jnp.asarray(t, state.position.dtype)
        before, falling = distance_and_its_rate(t - dt.astype(t.dtype), previous)
        after, rising = distance_and_its_rate(t, state)
        came = (falling < -self.slowest) & (before > rounding(previous, previous.velocity))
        in_step = before * rising - after * falling <= -1.5 * dt * falling * rising
        fastest = jnp.maximum(jnp.abs(previous.velocity), jnp.abs(state.velocity))
        there = after <= rounding(state, fastest)
        return previous.alive & state.alive & came & (there | ((rising > 0) & in_step))

    def check(self, particles: int, dim: int) -> None:
        for name in ("inherit", "margin", "slowest"):
            checks.shape(f"SubEmitter.{name}", getattr(self, name).shape, ())
        if self.contact is not None:
            check_collider(self.contact, dim)
        check_sampled_vectors(self, ("velocity", *([] if self.position is None else ["position"])), particles, dim)
