"""Drag: forces against the motion through a medium at rest."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler import _tree
from jeuler.forces.fields import per_particle


@_tree.component()
class QuadraticDrag:
    """Drag in proportion to the square of the speed.

        F_i = -c |v_i| v_i,   for a body of area A in a fluid of density rho: c = rho C_d A / 2

    Args:
      coefficient: c, shape () or (particle,), kg/m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
      At rest the force and its derivative are zero.
    Raises: ValueError, in `simulate`, if the coefficient has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.QuadraticDrag(0.5)(0.0, jnp.zeros((1, 2)), jnp.array([[3.0, 4.0]]), jnp.asarray(1.0)).tolist()
      [[-7.5, -10.0]]

    Source: Lord Rayleigh, On the resistance of fluids, 1876.
    """

    coefficient: _tree.Parameter

    def __post_init__(self) -> None:
        _tree.store_as_float(self, "coefficient")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        square = jnp.sum(velocity * velocity, axis=-1, keepdims=True)
        moving = square > 0
        speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1)), 0)
        return -per_particle(self.coefficient.astype(position.dtype)) * speed * velocity

    def check(self, particles: int, dim: int) -> None:
        if self.coefficient.shape not in ((), (particles,)):
            raise ValueError(
                f"QuadraticDrag.coefficient must have shape () or ({particles},), one a particle, "
                f"got {self.coefficient.shape}"
            )
