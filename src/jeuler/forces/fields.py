"""Force fields that act on every particle."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter
from jeuler._core.component import component, store_as_float
from jeuler._core.components import mass_that_feels, stack
from jeuler._core.in_time import at_time, moving


@component()
class Gravity:
    """A uniform field.

        F_i = m_i g

    A pinned particle (mass = inf) feels none.

    Args:
      acceleration: g, shape (dim,), m/s^2, or a function of time ``g(t) -> (dim,)``. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, in `simulate`, if its dim is not that of the positions.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.Gravity([0.0, -9.81])(0.0, jnp.zeros((1, 2)), jnp.zeros((1, 2)), jnp.asarray(2.0)).tolist()
      [[0.0, -19.6200008392334]]

    Source: I. Newton, Philosophiae naturalis principia mathematica, 1687.
    """

    acceleration: MovingParameter

    def __post_init__(self) -> None:
        if callable(self.acceleration):
            object.__setattr__(self, "acceleration", moving("Gravity.acceleration", self.acceleration))
        else:
            store_as_float(self, "acceleration")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        weight = jnp.broadcast_to(mass_that_feels(mass), position.shape[:1])
        return stack([weight * g for g in at_time(self.acceleration, t).astype(position.dtype)])

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy -sum_i m_i g.p_i, J."""
        return -jnp.sum(mass_that_feels(mass) * (position @ at_time(self.acceleration, t).astype(position.dtype)))

    def check(self, particles: int, dim: int) -> None:
        g = self.acceleration
        shape = jnp.shape(checks.form_of("Gravity.acceleration", g, 0.0) if callable(g) else g)
        checks.shape("Gravity.acceleration", shape, (dim,), meaning="one component for each of position's")
