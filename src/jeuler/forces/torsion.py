"""Torsion of chains, and bending of sheets about the edges of their triangles."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices, default
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.indices import particle_groups
from jeuler._core.limits import check_limits
from jeuler._core.vectors import apart
from jeuler.forces.neighbours import only_among


@component(static=("quads",), positive=("stiffness",))
class Torsion:
    """Resistance to twist about the middle link of four particles, or to folding two triangles about their edge.

        a = p_j - p_i,  b = p_k - p_j,  c = p_l - p_k
        phi = atan2(|b| a.(b x c), (a x b).(b x c))
        E = stiffness w^2 / 2,  w = phi - rest_angle between -pi and pi,   F = -dE/dp

    phi is the dihedral angle: 0 where i and l lie on the same side of the link j-k, pi in a flat zigzag. Two triangles
    (i, j, k) and (j, k, l) are flat at pi. Where i, j, k or j, k, l lie on one line there is no angle, and no force.

    Args:
      quads: (i, j, k, l), integers (quad, 4). Static.
      stiffness: () or (quad,), N m/rad^2. Differentiable.
      rest_angle: () or (quad,), rad. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, 3), N. It sums
      to zero and has no torque.
    Raises: ValueError, if quads is not an integer (quad, 4) array or names a particle twice, or the stiffness is
      negative; in `simulate`, if an index is out of range, or space has not three dimensions.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> fold = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])  # a right angle
      >>> jeuler.Torsion([[0, 1, 2, 3]], 2 / jnp.pi)(0.0, fold, 0 * fold, jnp.asarray(1.0)).round(4)[0].tolist()
      [0.0, 0.0, -1.0]

    Source: E. Grinspun et al., Discrete Shells, SCA 2003, sect. 3; A. Blondel, M. Karplus, J. Comput. Chem. 17, 1996.
    """

    quads: ParticleIndices
    stiffness: Parameter
    rest_angle: Parameter = default(float(np.pi))

    limits: ClassVar[dict[str, Any]] = {"stiffness": (">= 0", "N m/rad^2"), "rest_angle": ("", "rad")}

    def __post_init__(self) -> None:
        quads = particle_groups("Torsion.quads", self.quads, 4, "quad", "(i, j, k, l) with the axis from j to k")
        object.__setattr__(self, "quads", quads)
        store_as_float(self, "stiffness", "rest_angle")
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        corners = position[np.asarray(self.quads)]
        pull = jax.grad(lambda corners: jnp.sum(self._energies(corners)))(corners)
        return jnp.zeros_like(position).at[np.asarray(self.quads)].add(-pull)

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy, J."""
        return jnp.sum(self._energies(position[np.asarray(self.quads)]))

    def _energies(self, corners: Array) -> Array:
        """E of each quad, of its corners (quad, 4, 3)."""
        stiffness, rest = (x.astype(corners.dtype) for x in (self.stiffness, self.rest_angle))
        a, b, c = jnp.moveaxis(jnp.diff(corners, axis=1), 1, 0)
        m, n = jnp.cross(a, b), jnp.cross(b, c)
        has_angle = apart(jnp.sum(m * m, axis=1)) & apart(jnp.sum(n * n, axis=1))
        length = jnp.sqrt(jnp.where(has_angle, jnp.sum(b * b, axis=1), 1))
        sine = jnp.where(has_angle, length * jnp.sum(a * n, axis=1), 0)
        off = jnp.atan2(sine, jnp.where(has_angle, jnp.sum(m * n, axis=1), 1)) - rest
        off = off - 2 * jnp.pi * jnp.round(jax.lax.stop_gradient(off) / (2 * jnp.pi))
        return jnp.where(has_angle, stiffness * off**2 / 2, 0)

    def prepare(self, context: Any) -> Torsion:
        """Only between the living."""
        if context.alive is None:
            return self
        return replace(self, stiffness=only_among(context.alive, self.quads, self.stiffness))

    def check(self, particles: int, dim: int) -> None:
        if dim != 3:
            raise ValueError(f"Torsion must be in space, dim = 3, got dim = {dim}; in the plane use Bending")
        checks.indices("Torsion.quads", self.quads, particles, "particle indices")
        for name in ("stiffness", "rest_angle"):
            shape = getattr(self, name).shape
            checks.shape(f"Torsion.{name}", shape, (), (len(self.quads),), meaning="one a quad")
