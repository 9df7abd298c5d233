"""Springs with dampers between pairs of particles."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler import _tree
from jeuler.forces.topology import Topology


def direction(d: Array) -> tuple[Array, Array]:
    """Length r and unit vector u = d / r along the last axis; both, and all their derivatives, are 0 at r = 0.

    Ends closer than tiny^(1/3) (2e-13 in float32, 3e-103 in float64) count as coincident: below that, the second
    derivative of r overflows.
    """
    square = jnp.sum(d * d, axis=-1, keepdims=True)
    apart = square > jnp.finfo(d.dtype).tiny ** (2 / 3)
    r = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
    return r, jnp.where(apart, d / jnp.where(apart, r, 1), 0)


def spring_force(d: Array, relative_velocity: Array, ks: Array, kd: Array, rest_length: Array) -> Array:
    """The force on the first end of each spring, (spring, dim).

        F = -ks d + (ks L - kd (v.u)) u

    the same as ks (L - |d|) u - kd (v.u) u, but linear in d where L = 0, so that its derivative at d = 0 is -ks I.
    """
    _, u = direction(d)
    approach = jnp.sum(relative_velocity * u, axis=-1, keepdims=True)
    return -ks * d + (ks * rest_length - kd * approach) * u


@_tree.component(static=("edges",))
class Springs:
    """Linear springs and dampers between pairs of particles.

        d = p_i - p_j,  r = |d|,  u = d / r
        F_i = ks (L - r) u - kd ((v_i - v_j).u) u,   F_j = -F_i

    At r = 0 the direction u is taken as 0: the force is finite, and with L = 0 it is 0 with derivative exactly -ks I.

    Args:
      edges: the two particles (i, j) of each spring, integers (spring, 2). Static: part of the program. May be empty.
      ks: stiffness of each spring, shape () or (spring,), N/m. Differentiable.
      kd: damping of each spring, shape () or (spring,), N s/m. Differentiable.
      rest_length: L, length without force, shape () or (spring,), m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if edges is not an integer (spring, 2) array or joins a particle to itself; in `simulate`, if
      an index is out of range or a parameter has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> spring = jeuler.Springs([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0)
      >>> spring(0.0, jnp.array([[0.0], [1.5]]), jnp.zeros((2, 1)), jnp.asarray(1.0)).tolist()
      [[5.0], [-5.0]]
    Source: D. Baraff, A. Witkin, Physically Based Modeling, SIGGRAPH course notes, 2001, particle systems, sect. 3.
    """

    edges: Topology
    ks: Array
    kd: Array
    rest_length: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", Topology(self.edges))
        _tree.store_as_float(self, "ks", "kd", "rest_length")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        ks, kd, rest_length = (self._per_spring(x, position.dtype) for x in (self.ks, self.kd, self.rest_length))
        d, relative_velocity = self.edges.difference(position), self.edges.difference(velocity)
        force = spring_force(d, relative_velocity, ks, kd, rest_length)
        return self.edges.accumulate(force, len(position))

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy sum ks (r - L)^2 / 2, J."""
        ks, rest_length = (self._per_spring(x, position.dtype) for x in (self.ks, self.rest_length))
        r, _ = direction(self.edges.difference(position))
        return jnp.sum(ks * (r - rest_length) ** 2) / 2

    def among(self, alive: Array) -> Springs:
        """Springs between the living only: a spring with a dead end has no stiffness and no damping."""
        both = jnp.all(alive[self.edges[:]], axis=1)
        return _tree.replace(self, ks=jnp.where(both, self.ks, 0), kd=jnp.where(both, self.kd, 0))

    @staticmethod
    def _per_spring(x: Array, dtype: Any) -> Array:
        return x.astype(dtype)[:, None] if x.ndim else x.astype(dtype)

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        for name in ("ks", "kd", "rest_length"):
            shape = getattr(self, name).shape
            if shape not in ((), (len(self.edges),)):
                raise ValueError(
                    f"Springs.{name} must have shape () or ({len(self.edges)},), one a spring, got {shape}"
                )
