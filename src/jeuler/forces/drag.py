"""Drag: forces against the motion through the air, or along with it where it blows."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import AirParameter, OptionalParameter, Parameter, default
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.components import by_component, split, stack
from jeuler.forces.air import air_velocity, as_air, check_air


def through_air(air: tuple[Any, ...], t: Any, position: Array, velocity: Array) -> Array:
    """The velocity of each particle relative to the air, (particle, dim)."""
    return by_component(jnp.subtract, velocity, jnp.asarray(air_velocity(air, t, position))) if air else velocity


def unless_too_long(rate: Array, dt: Array) -> Array:
    """min(1, 1 / (rate dt)): by how much a force that slows at this rate (1/s) must shrink not to overshoot in dt.

    Exactly 1 where rate dt <= 1: there the force is the plain one, to the last bit, and the order of a step is kept.
    """
    steps = rate * dt.astype(rate.dtype)
    too_long = steps > 1
    return jnp.where(too_long, 1 / jnp.where(too_long, steps, 1), 1)


@component(positive=("coefficient",))
class LinearDrag:
    """Drag in proportion to the speed relative to the air (Stokes drag).

        F_i = -c (v_i - w(p_i, t)),   for a sphere of radius r in a fluid of viscosity mu: c = 6 pi mu r

    In `simulate` no particle overshoots the air, at any dt: where c dt / m > 1 the force is the one that takes the
    particle to the speed of the air within the step.

    Args:
      coefficient: c, shape () or (particle,), kg/s, >= 0. Differentiable.
      air: the velocity w of the air: None at rest, (dim,) m/s, a field such as `Wind`, `Gust`, `Vortex` or
        `turbulence(...)`, any function ``air(t, position) -> (particle, dim)``, or a tuple of these, which add up.
      longest_step: set by `simulate`, s.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, in `simulate`, if the coefficient or the air has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> drag = jeuler.LinearDrag(0.5, air=[2.0, 0.0])
      >>> drag(0.0, jnp.zeros((1, 2)), jnp.array([[0.0, 4.0]]), jnp.asarray(1.0)).tolist()
      [[1.0, -2.0]]

    Source: G. G. Stokes, On the effect of the internal friction of fluids on the motion of pendulums, 1851.
    """

    coefficient: Parameter
    air: AirParameter = default(None)
    longest_step: OptionalParameter = default(None)

    def __post_init__(self) -> None:
        store_as_float(self, "coefficient")
        object.__setattr__(self, "air", as_air(self.air))

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        c = self.coefficient.astype(position.dtype)
        if self.longest_step is not None:
            c = c * unless_too_long(c / mass, self.longest_step)
        return by_component(lambda u: -c * u, through_air(self.air, t, position, velocity))

    def for_step(self, dt: Array) -> LinearDrag:
        return replace(self, longest_step=dt)

    def check(self, particles: int, dim: int) -> None:
        check_coefficient("LinearDrag", self.coefficient, particles)
        check_air("LinearDrag", self.air, particles, dim)


@component(positive=("coefficient",))
class QuadraticDrag:
    """Drag in proportion to the square of the speed relative to the air.

        F_i = -c |u| u,   u = v_i - w(p_i, t),   for a body of area A in a fluid of density rho: c = rho C_d A / 2

    In `simulate` no particle overshoots the air, at any dt: where c |u| dt / m > 1 the force is the one that takes
    the particle to the speed of the air within the step.

    Args:
      coefficient: c, shape () or (particle,), kg/m, >= 0. Differentiable.
      air: the velocity w of the air: None at rest, (dim,) m/s, a field such as `Wind`, `Gust`, `Vortex` or
        `turbulence(...)`, any function ``air(t, position) -> (particle, dim)``, or a tuple of these, which add up.
      longest_step: set by `simulate`, s.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
      At the speed of the air the force and its derivative are zero.
    Raises: ValueError, in `simulate`, if the coefficient or the air has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.QuadraticDrag(0.5)(0.0, jnp.zeros((1, 2)), jnp.array([[3.0, 4.0]]), jnp.asarray(1.0)).tolist()
      [[-7.5, -10.0]]

    Source: Lord Rayleigh, On the resistance of fluids, 1876.
    """

    coefficient: Parameter
    air: AirParameter = default(None)
    longest_step: OptionalParameter = default(None)

    def __post_init__(self) -> None:
        store_as_float(self, "coefficient")
        object.__setattr__(self, "air", as_air(self.air))

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        relative = split(through_air(self.air, t, position, velocity))
        square = sum(u * u for u in relative)
        moving = square > 0
        speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1)), 0)
        c = self.coefficient.astype(position.dtype)
        if self.longest_step is not None:
            c = c * unless_too_long(c * speed / mass, self.longest_step)
        return stack([-c * speed * u for u in relative])  # of one split, or gradients would be (particle, dim)

    def for_step(self, dt: Array) -> QuadraticDrag:
        return replace(self, longest_step=dt)

    def check(self, particles: int, dim: int) -> None:
        check_coefficient("QuadraticDrag", self.coefficient, particles)
        check_air("QuadraticDrag", self.air, particles, dim)


def check_coefficient(name: str, coefficient: Array, particles: int) -> None:
    checks.shape(f"{name}.coefficient", coefficient.shape, (), (particles,), meaning="one a particle")
