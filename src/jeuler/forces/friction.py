"""Friction that does not grow with the speed."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter
from jeuler._core.component import component, store_as_float
from jeuler._core.components import per_particle
from jeuler._core.limits import check_limits
from jeuler._core.vectors import direction


@component(positive=("coefficient", "slow"))
class DryFriction:
    """Coulomb friction of a bearing or a guide: of one size at any speed, smoothed where it turns around.

        F_i = -c tanh(|v_i| / slow) v_i / |v_i|

    Below the speed ``slow`` it is a viscous drag of c / slow: what would stick creeps, and a step dt should be below
    m slow / c.

    Args:
      coefficient: c, shape () or (particle,), N. Differentiable.
      slow: (), m/s, > 0: small against the speeds of the motion. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if the coefficient is negative or slow is not above 0; in `simulate`, if one has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> guide = jeuler.DryFriction(0.5, slow=0.01)
      >>> guide(0.0, jnp.zeros((2, 1)), jnp.array([[3.0], [-0.2]]), jnp.asarray(1.0)).tolist()
      [[-0.5], [0.5]]
    """

    coefficient: Parameter
    slow: Parameter

    limits: ClassVar[dict[str, Any]] = {"coefficient": (">= 0", "N"), "slow": ("> 0", "m/s")}

    def __post_init__(self) -> None:
        store_as_float(self, "coefficient", "slow")
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        speed, along = direction(velocity)
        c, slow = (x.astype(velocity.dtype) for x in (self.coefficient, self.slow))
        return -per_particle(c) * jnp.tanh(speed / slow) * along

    def check(self, particles: int, dim: int) -> None:
        checks.shape("DryFriction.coefficient", self.coefficient.shape, (), (particles,), meaning="one a particle")
        checks.shape("DryFriction.slow", self.slow.shape, (), meaning="one number")
