"""Births at a rate and in bursts. They come before the motion of a step, in the order written."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.annotations import MovingParameter, Parameter, SampledParameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import as_component, component, store_as_float
from jeuler._core.in_time import at_time, moving
from jeuler._core.limits import Limits, check_limits
from jeuler.effects.pool import (
    check_sampled_vectors,
    fields_of_births,
    first_free,
    most_births,
    put_newborns,
    samplers_of,
    store_samplers,
)  # fmt: skip
from jeuler.particles.fields import BEFORE
from jeuler.samplers.base import Uniform, draw_named


@component(static=("bursts", "max_births"))
class Emitter:
    """Births: a steady stream and bursts, into the first free slots of the pool.

        births in step n = floor((n + 1) rate dt) - floor(n rate dt) + the bursts nearest to its start

    n counts from the first step of the run, or of the run that this one goes on from (``state.steps``).

    A newborn is placed where it would be had it been born at a random moment of the step, so that a fast jet shows no
    layers. A birth that finds no free slot, or goes beyond ``max_births``, is counted in ``state.missed_births``; all
    that take place are counted in ``state.births``. Gradients flow through every drawn attribute to the parameters of
    its sampler; the number of births, the slot and the moment carry none, so the derivative by ``rate`` is 0.

    Args:
      rate: births a second, (), 1/s, >= 0, or a function of time ``rate(t)``: its births follow each other as evenly as
        they can, so that a part of a run has as many as its integral says to within 2 or 3.
      position: where, a sampler ``(key, count) -> (count, dim)`` such as `FromSphere`, or one point (dim,), m.
      velocity: how fast, a sampler such as `Cone` or `Normal`, or one vector (dim,), m/s.
      lifetime, mass, color, opacity, size, shape: what newborns get, a sampler or one value; None leaves the field
        out of the state, or at its default where another part of the scene has it.
      extra: samplers of further fields, by name; one that is in the state and not named here is 0 for a newborn.
      path: None, or a function of time ``path(t) -> (dim,)``, m, by which the places of birth move; a newborn is where
        the path was at its moment of birth.
      inherit: the share of the path's velocity that newborns have beside their own, ().
      bursts: pairs (time in s, number of births). Static.
      start, stop: the stream runs from start to stop, s.
      max_births: the most births in one step, an integer; fewer draws cost less. None allows the whole pool. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with the births of the step from t
      to t + dt.
    Raises: ValueError, if rate, lifetime or mass is out of range, a burst is not a pair (time, number) or max_births is
      below 1; in `simulate`, if it got no key, or a sampler's shape does not fit.
    Example:
      >>> import jax, jeuler
      >>> jet = jeuler.Emitter(100.0, position=[0.0, 0.0], velocity=jeuler.Cone([0.0, 1.0], speed=5.0, angle=0.3))
      >>> scene = jeuler.Scene(forces=(jeuler.Gravity([0.0, -9.81]),), effects=(jet,))
      >>> end = jeuler.simulate(scene, jeuler.empty_pool(60, dim=2), dt=0.01, num_steps=100, key=jax.random.key(0))
      >>> int(end.y.births[-1]), int(end.y.missed_births[-1])
      (60, 40)

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983, sect. 2.1-2.2.
    """

    rate: MovingParameter
    position: SampledParameter
    velocity: SampledParameter
    lifetime: SampledParameter = default(None)
    mass: SampledParameter = default(None)
    color: SampledParameter = default(None)
    opacity: SampledParameter = default(None)
    size: SampledParameter = default(None)
    shape: SampledParameter = default(None)
    extra: dict[str, Any] | None = None
    bursts: tuple[tuple[float, int], ...] = ()
    start: Parameter = default(0.0)
    stop: Parameter = default(jnp.inf)
    path: MovingParameter = default(None)
    inherit: Parameter = default(0.0)
    max_births: int | None = None

    acts = BEFORE
    needs: ClassVar[tuple[str, ...]] = ("key", "clock", "forward time")
    limits: ClassVar[Limits] = {"rate": (">= 0", "1/s"), "start": ("", "s"), "stop": ("", "s"), "inherit": ("", "")}
    may_be_infinite: ClassVar[tuple[str, ...]] = ("start", "stop")

    def __post_init__(self) -> None:
        if callable(self.rate):
            object.__setattr__(self, "rate", moving("Emitter.rate", self.rate))
        else:
            checks.number("Emitter.rate", self.rate)
            if not checks.is_traced(self.rate) and float(self.rate) < 0:
                raise ValueError(f"Emitter.rate must be at least 0 births a second, got {self.rate!r}")
            store_as_float(self, "rate")
        if self.path is not None:
            checks.function("Emitter.path", self.path, "(t) -> (dim,)", "write lambda t: jnp.stack([...])")
            object.__setattr__(self, "path", as_component(self.path))
        try:
            bursts = tuple((_finite_time(time), checks.count("number", number)) for time, number in self.bursts)
        except (TypeError, ValueError):
            raise ValueError(
                f"Emitter.bursts must be pairs (time in s, number of births >= 0), got {checks.shown(self.bursts)}; "
                f"write bursts=((0.5, 100),)"
            ) from None
        object.__setattr__(self, "bursts", bursts)
        store_as_float(self, "start", "stop", "inherit")
        store_samplers(self, "position", "velocity")
        check_limits(self)

    @property
    def writes(self) -> dict[str, tuple[int, ...]]:
        return fields_of_births(self)

    def number_of_births(
        self, t: Any, dt: Any, clock: tuple[Any, Any] | None = None, steps: Array | None = None
    ) -> Array:
        """Births in the step that starts at t; ``clock`` is the number of that step in its run, and the run's start.

        ``steps``: its number with the run that this one goes on from.
        """
        n, t0 = (step_number(t, dt), 0.0) if clock is None else clock
        number = (n if steps is None else steps).astype(jnp.int32)
        if callable(self.rate):
            per_step = jnp.maximum(lax.stop_gradient(at_time(self.rate, t + dt / 2) * dt), 0)
            births = births_by_turns(number, per_step)
        else:
            births = births_of_stream(number, lax.stop_gradient(self.rate * dt))
        streaming = (t + dt / 2 >= self.start) & (t + dt / 2 < self.stop)
        stream = jnp.where(streaming, births, 0)
        burst = sum(jnp.where(step_number(time - t0, dt) == n, many, 0) for time, many in self.bursts)
        return (stream + burst).astype(jnp.int32)

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Array, *, clock: Any = None) -> Any:
        block = most_births(self, len(state.position))
        slot, free = first_free(state.alive, block)
        wanted = self.number_of_births(t, dt, clock, state.steps)
        births = jnp.minimum(wanted, jnp.minimum(free, block))
        named = {"position": self.position, "velocity": self.velocity, **samplers_of(self)}
        dtype = trees.time_dtype(state.position)
        values = draw_named({"moment of birth": Uniform(0.0, 1.0), **named}, key, block, dtype)
        since_step = dt * values.pop("moment of birth")
        if self.path is not None:
            values["position"], values["velocity"] = self._moving(t, values["position"], values["velocity"], since_step)
        values["position"] = values["position"] - since_step[:, None] * values["velocity"]
        if state.age is not None:
            values["age"] = -since_step
        return put_newborns(self, state, slot, births, wanted, values)

    def _moving(self, t: Any, position: Array, velocity: Array, since_step: Array) -> tuple[Array, Array]:
        """Places and velocities of newborns on the path, each where it was at the moment of birth."""

        def along(time):
            return jax.jvp(self.path, (time,), (jnp.ones_like(time),))

        place, speed = jax.vmap(along)(jnp.asarray(t, since_step.dtype) + since_step)
        return position + place.astype(position.dtype), velocity + self.inherit * speed.astype(velocity.dtype)

    def check(self, particles: int, dim: int) -> None:
        if self.path is not None:
            form = checks.form_of("Emitter.path", self.path, 0.0)
            checks.shape("Emitter.path(t)", getattr(form, "shape", ()), (dim,), meaning="one number a dimension")
        if callable(self.rate):
            form = checks.form_of("Emitter.rate", self.rate, 0.0)
            checks.shape("Emitter.rate(t)", getattr(form, "shape", ()), ())
        check_sampled_vectors(self, ("position", "velocity"), particles, dim)


def _finite_time(time: Any) -> float:
    checks.number("time", time)
    return float(time)


def births_of_stream(n: Array, per_step: Array) -> Array:
    """floor((n + 1) p + e) - floor(n p + e) in integers, whose products do not round however large n is.

    p is a whole number and so many 2^-32; a fraction of a birth e = 2^-10 makes up for the rounding of p.
    """
    whole = jnp.floor(per_step)
    share = ((per_step - whole) * 2.0**16).astype(per_step.dtype)
    high = jnp.floor(share)
    part = high.astype(jnp.uint32) * jnp.uint32(2**16) + ((share - high) * 2.0**16).astype(jnp.uint32)
    before = n.astype(jnp.uint32) * part + jnp.uint32(2**22)
    return whole.astype(jnp.int32) + (before + part < before).astype(jnp.int32)


def births_by_turns(n: Array, per_step: Array) -> Array:
    """p births in step n on average, for a p that changes: floor(p + the n-th of evenly spread fractions).

    The fractions are those of n times the golden ratio, in 32 bits, so that sums over consecutive steps are as near
    their mean as can be.
    """
    fraction = (n.astype(jnp.uint32) * jnp.uint32(2654435769) >> 8).astype(jnp.float32) * 2.0**-24
    return jnp.floor(per_step + fraction.astype(per_step.dtype)).astype(jnp.int32)


def step_number(t: Any, dt: Any) -> Array:
    """t / dt to an integer that grows by exactly one a step: rounding puts the edge away from the usual fractions."""
    return jnp.floor(lax.stop_gradient(t / dt) + 0.618)
