"""Forces of the models that the command line fits, beside those of `jeuler.forces`: coefficients of either sign."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core.annotations import Parameter
from jeuler._core.component import component


@component(static=("pendulum",))
class Restoring:
    """The pull of an anchor towards 0, the same in every coordinate: a spring, a hardening spring, a pendulum.

    F = -stiffness x - cubic x^3 - damping v,    with sin(x) for x and no cubic term where it is a pendulum
    """

    stiffness: Parameter
    damping: Parameter
    cubic: Parameter | None
    pendulum: bool

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
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
    """A measured force, sampled at times that are `step` apart, constant before and after.

    F = gain u(t), linear between the samples
    """

    gain: Parameter
    samples: Array
    begin: Array
    step: Array

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        place = jnp.clip((t - self.begin) / self.step, 0, len(self.samples) - 1)
        k = jnp.clip(jnp.floor(place).astype(int), 0, len(self.samples) - 2)
        u = self.samples[k] + (place - k) * (self.samples[k + 1] - self.samples[k])
        return self.gain * u + 0 * position
