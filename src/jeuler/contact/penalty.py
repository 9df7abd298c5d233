"""Contact as a force: a smooth push where a particle overlaps a collider, in place of an impact."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import ColliderParameter, Parameter, default
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler.contact.colliders import as_collider, check_collider, normal_and_speed


@component(positive=("ks", "kd", "radius"))
class PenaltyContact:
    """A stiff one-sided spring and damper at the surface of a collider.

        overlap = max(radius - distance, 0),   F = max(ks overlap - kd v_n, 0) n where overlap > 0

    Smooth in the position but never exact: the particle sinks in, and the gradient through a bounce is that of the
    spring, on a time scale pi sqrt(m / ks) that the step has to resolve. `Collisions` has the exact gradient.

    Args:
      collider: `Plane`, `Sphere`, `Box`, or any signed distance ``(t, point) -> ()``.
      ks: stiffness, (), N/m. Differentiable.
      kd: damping of the approach, (), N s/m. Differentiable.
      radius: of each particle, () or (particle,), m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, in `simulate`, if a shape does not fit or a parameter that is not traced is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> floor = jeuler.PenaltyContact(jeuler.Plane([0.0, 0.0], [0.0, 1.0]), ks=100.0)
      >>> floor(0.0, jnp.array([[3.0, -0.5]]), jnp.zeros((1, 2)), jnp.asarray(1.0)).tolist()
      [[0.0, 50.0]]

    Source: M. Moore, J. Wilhelms, Collision Detection and Response for Computer Animation, SIGGRAPH 1988, sect. 3.1.
    """

    collider: ColliderParameter
    ks: Parameter
    kd: Parameter = default(0.0)
    radius: Parameter = default(0.0)

    limits: ClassVar[dict[str, Any]] = {"ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m"), "radius": (">= 0", "m")}

    def __post_init__(self) -> None:
        object.__setattr__(self, "collider", as_collider("PenaltyContact.collider", self.collider))
        store_as_float(self, "ks", "kd", "radius")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        ks, kd, radius = (x.astype(position.dtype) for x in (self.ks, self.kd, self.radius))
        t = jnp.asarray(t, position.dtype)
        overlap = radius - jax.vmap(self.collider, (None, 0))(t, position)
        normal, recession = jax.vmap(normal_and_speed, (None, None, 0))(self.collider, t, position)
        leaving = jnp.sum(velocity * normal, axis=-1) + recession
        push = jnp.where(overlap > 0, jnp.maximum(ks * overlap - kd * leaving, 0), 0)
        return push[:, None] * normal

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy sum ks overlap^2 / 2, J."""
        distance = jax.vmap(self.collider, (None, 0))(jnp.asarray(t, position.dtype), position)
        overlap = jnp.maximum(self.radius.astype(position.dtype) - distance, 0)
        return jnp.sum(self.ks.astype(position.dtype) * overlap**2) / 2

    def check(self, particles: int, dim: int) -> None:
        for name, shapes in (("ks", ((),)), ("kd", ((),)), ("radius", ((), (particles,)))):
            checks.shape(f"PenaltyContact.{name}", getattr(self, name).shape, *shapes)
        check_limits(self)
        check_collider(self.collider, dim)
