"""Forces of the models that the command line fits, beside those of `jeuler.forces`: coefficients of either sign."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core.annotations import Parameter
from jeuler._core.component import component


@component()
class Samples:
    """A measured function of time, sampled every `step`: linear between the samples, constant before and after."""

    values: Array
    begin: Array
    step: Array

    def at(self, t: Any) -> Array:
        """The value at a time."""
        return self._between(self.values, t)

    def slope_at(self, t: Any) -> Array:
        """The slope at a time, from central differences."""
        return self._between(jnp.asarray(jnp.gradient(self.values, self.step)), t)

    def _between(self, values: Array, t: Any) -> Array:
        place = jnp.clip((t - self.begin) / self.step, 0, len(values) - 1)
        k = jnp.clip(jnp.floor(place).astype(int), 0, len(values) - 2)
        return values[k] + (place - k) * (values[k + 1] - values[k])


@component(static=("pendulum",))
class Restoring:
    """The pull of an anchor towards 0, the same in every coordinate: a spring, a hardening spring, a pendulum.

    F = -stiffness x - cubic x^3 - damping v,    with sin(x) for x and no cubic term where it is a pendulum

    and x - s(t), v - s'(t) for x, v where the anchor is a support that moves by s(t).
    """

    stiffness: Parameter
    damping: Parameter
    cubic: Parameter | None
    support: Samples | None
    pendulum: bool

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        if self.support is not None:
            position, velocity = position - self.support.at(t), velocity - self.support.slope_at(t)
        pull = self.stiffness * (jnp.sin(position) if self.pendulum else position) + self.damping * velocity
        return -pull if self.cubic is None else -pull - self.cubic * position**3


@component()
class DryFriction:
    """Coulomb friction, smoothed where the speed is below `slow`.

    F = -coefficient tanh(v / slow)
    """

    coefficient: Parameter
    slow: Parameter

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return -self.coefficient * jnp.tanh(velocity / self.slow)


@component()
class SignedQuadraticDrag:
    """Drag that grows as the square of the speed, of either sign of the coefficient so that a fit can pass 0.

    F = -coefficient |v| v
    """

    coefficient: Parameter

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        squares = jnp.sum(velocity**2, axis=1, keepdims=True)
        still = squares <= 0
        speed = jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, squares)))
        return -self.coefficient * speed * velocity


@component()
class Driving:
    """A measured force.

    F = gain u(t)
    """

    gain: Parameter
    samples: Samples

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return self.gain * self.samples.at(t) + 0 * position
