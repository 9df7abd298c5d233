"""Forces between the neighbours of a fixed topology: viscosity and bending."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices, default
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.indices import particle_groups
from jeuler._core.limits import check_limits
from jeuler._core.vectors import direction
from jeuler.graphs.topology import topology


@component(static=("edges",), positive=("coefficient",))
class Viscosity:
    """Friction between neighbours: each particle is dragged along by those that it is joined to.

        F_i = c (v_j - v_i),   F_j = -F_i

    Unlike a spring's damper it acts in every direction, not only along the edge.

    Args:
      edges: the two particles of each pair, integers (pair, 2). Static.
      coefficient: c, shape () or (pair,), N s/m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if edges is not an integer (pair, 2) array or the coefficient is negative; in `simulate`, if an
      index is out of range.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> v = jnp.array([[1.0, 0.0], [0.0, 0.0]])
      >>> jeuler.Viscosity([[0, 1]], 0.5)(0.0, jnp.zeros((2, 2)), v, jnp.asarray(1.0)).tolist()
      [[-0.5, 0.0], [0.5, 0.0]]

    Source: D. Terzopoulos, J. Platt, K. Fleischer, Heating and melting deformable models, 1991.
    """

    edges: ParticleIndices
    coefficient: Parameter

    limits: ClassVar[dict[str, Any]] = {"coefficient": (">= 0", "N s/m")}

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", topology(self.edges))
        store_as_float(self, "coefficient")
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        c = self.coefficient.astype(position.dtype)
        c = c[:, None] if c.ndim else c
        return self.edges.accumulate(-c * self.edges.difference(velocity), len(position))

    def prepare(self, context: Any) -> Viscosity:
        """Only between the living."""
        if context.alive is None:
            return self
        return replace(self, coefficient=only_among(context.alive, self.edges, self.coefficient))

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        shape = self.coefficient.shape
        checks.shape("Viscosity.coefficient", shape, (), (len(self.edges),), meaning="one a pair")


def only_among(alive: Array, groups: Any, coefficient: Array) -> Array:
    """The coefficient of each group of particles, 0 where one of them is dead: (group,)."""
    return jnp.where(jnp.all(alive[np.asarray(groups)], axis=1), coefficient, 0)


@component(static=("triples",), positive=("stiffness",))
class Bending:
    """Resistance of a rope, a hair or a cloth to bending, about each middle particle.

        e = p_j - p_i,  f = p_k - p_j,  theta = the angle between e and f
        E = stiffness (theta - rest_angle)^2 / 2,   F = -dE/dp

    Straight has angle 0. Where the angle is exactly 0 or pi the direction of bending is not determined: the part of
    the force that needs it is 0 there.

    Args:
      triples: (i, j, k), j in the middle, integers (triple, 3). Static.
      stiffness: () or (triple,), N m/rad^2. Differentiable.
      rest_angle: () or (triple,), rad. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
      It sums to zero and has no torque.
    Raises: ValueError, if triples is not an integer (triple, 3) array or names a particle twice, or the stiffness is
      negative; in `simulate`, if an index is out of range.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> corner = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
      >>> jeuler.Bending([[0, 1, 2]], 2 / jnp.pi)(0.0, corner, 0 * corner, jnp.asarray(1.0)).round(4).tolist()
      [[0.0, -1.0], [-1.0, 1.0], [1.0, 0.0]]

    Source: M. Bergou et al., Discrete Elastic Rods, ACM Transactions on Graphics 27, 2008, sect. 4.2 (turning angle).
    """

    triples: ParticleIndices
    stiffness: Parameter
    rest_angle: Parameter = default(0.0)

    limits: ClassVar[dict[str, Any]] = {"stiffness": (">= 0", "N m/rad^2"), "rest_angle": ("", "rad")}

    def __post_init__(self) -> None:
        triples = particle_groups("Bending.triples", self.triples, 3, "triple", "(i, j, k) with j in the middle")
        object.__setattr__(self, "triples", triples)
        store_as_float(self, "stiffness", "rest_angle")
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        i, j, k = np.asarray(self.triples).T
        stiffness, rest = (x.astype(position.dtype) for x in (self.stiffness, self.rest_angle))
        e, f = position[j] - position[i], position[k] - position[j]
        e_length, e_unit = direction(e)
        f_length, f_unit = direction(f)
        cosine = jnp.sum(e_unit * f_unit, axis=1)
        _, theta_over_sine, one_over_sine = angle_from(e_unit, f_unit, cosine)
        # dE/dp = -stiffness (theta - rest) / sin(theta) d(cos theta)/dp
        pull = (stiffness * (theta_over_sine - rest * one_over_sine))[:, None]
        on_i = -pull * (f_unit - cosine[:, None] * e_unit) * reciprocal(e_length)
        on_k = pull * (e_unit - cosine[:, None] * f_unit) * reciprocal(f_length)
        total = jnp.zeros_like(position)
        return total.at[i].add(on_i).at[j].add(-on_i - on_k).at[k].add(on_k)

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy, J."""
        i, j, k = np.asarray(self.triples).T
        _, e = direction(position[j] - position[i])
        _, f = direction(position[k] - position[j])
        theta, _, _ = angle_from(e, f, jnp.sum(e * f, axis=1))
        return jnp.sum(self.stiffness * (theta - self.rest_angle) ** 2) / 2

    def prepare(self, context: Any) -> Bending:
        """Only between the living."""
        if context.alive is None:
            return self
        return replace(self, stiffness=only_among(context.alive, self.triples, self.stiffness))

    def check(self, particles: int, dim: int) -> None:
        checks.indices("Bending.triples", self.triples, particles, "particle indices")
        for name in ("stiffness", "rest_angle"):
            shape = getattr(self, name).shape
            checks.shape(f"Bending.{name}", shape, (), (len(self.triples),), meaning="one a triple")


def reciprocal(length: Array) -> Array:
    """1 / length, and 0 where the length is 0."""
    return jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 0)


def angle_from(e: Array, f: Array, cosine: Array) -> tuple[Array, Array, Array]:
    """theta between unit vectors, theta / sin(theta) (1 at 0), and 1 / sin(theta) (0 at 0 and pi)."""
    half_sine = jnp.sum((f - e) ** 2, axis=1) / 4  # sin^2(theta / 2), exact for small angles
    square = 4 * half_sine * (1 - half_sine)  # sin^2(theta)
    bent = square > 1e-10 if e.dtype == jnp.float64 else square > 1e-6
    sine = jnp.sqrt(jnp.where(bent, square, 1))
    theta = jnp.where(bent, jnp.atan2(sine, cosine), jnp.where(cosine > 0, 0, jnp.pi))
    ratio = jnp.where(bent, theta / sine, jnp.where(cosine > 0, 1 + square / 6, 0))
    return theta, ratio, jnp.where(bent, 1 / sine, 0)
