"""Points that pull or push."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, Parameter
from jeuler._core.component import component, store_as_float
from jeuler._core.components import mass_that_feels, per_particle
from jeuler._core.in_time import at_time, moving
from jeuler._core.limits import check_limits


@component(static=("power",), positive=("softening",))
class PointAttractor:
    """A point that pulls every particle; with negative strength it pushes.

        F_i = m_i strength d / (|d|^2 + softening^2)^((power + 1) / 2),   d = center - p_i

    Far away the acceleration is strength / |d|^power. At the point itself the force is 0.

    Args:
      center: (dim,), m, or a function of time ``center(t) -> (dim,)``, such as a `SampledPath`. Differentiable.
      strength: (), m^(power+1)/s^2, or a function of time. Differentiable.
      softening: (), m, > 0: the distance below which the pull no longer grows. Differentiable.
      power: 2 for gravity, 1 for a line charge, 0 for the same pull at any distance. Static.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
      A pinned particle feels none.
    Raises: ValueError, if the softening is not above 0 or power is no number; in `simulate`, if the center has
      another dim.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> sun = jeuler.PointAttractor([0.0, 0.0], strength=4.0, softening=1e-6)
      >>> sun(0.0, jnp.array([[2.0, 0.0]]), jnp.zeros((1, 2)), jnp.asarray(3.0)).round().tolist()
      [[-3.0, 0.0]]

    Source: H. C. Plummer, On the problem of distribution in globular star clusters, 1911 (the softening).
    """

    center: MovingParameter
    strength: MovingParameter
    softening: Parameter
    power: float = 2

    limits: ClassVar[dict[str, Any]] = {"center": ("", "m"), "strength": ("", ""), "softening": ("> 0", "m")}
    axes: ClassVar[dict[str, int]] = {"center": 1, "strength": 0, "softening": 0}

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", moving("PointAttractor.center", self.center))
        object.__setattr__(self, "strength", moving("PointAttractor.strength", self.strength))
        store_as_float(self, "softening")
        checks.number("PointAttractor.power", self.power)
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        d = at_time(self.center, t, position.dtype) - position
        square = jnp.sum(d * d, axis=1, keepdims=True) + self.softening.astype(position.dtype) ** 2
        acceleration = at_time(self.strength, t, position.dtype) * d * square ** (-(self.power + 1) / 2)
        return per_particle(mass_that_feels(mass)) * acceleration

    def check(self, particles: int, dim: int) -> None:
        checks.shape("PointAttractor.center", jax.eval_shape(at_time, self.center, jnp.zeros(())).shape, (dim,))
