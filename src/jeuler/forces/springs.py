"""Springs with dampers between pairs of particles."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.components import split, stack
from jeuler._core.limits import check_limits
from jeuler._core.vectors import apart, direction, dot
from jeuler._jax.materialise import stored
from jeuler.graphs.layouts import Layout
from jeuler.graphs.topology import Topology


@jax.custom_jvp
def inverse_length(square: Array) -> Array:
    """1 / r from r^2; 0, and all derivatives 0, where the ends coincide (see `apart`)."""
    long = apart(square)
    return jnp.where(long, 1, 0) / jnp.where(long, jnp.sqrt(jnp.where(long, square, 1)), 1)


@inverse_length.defjvp
def _inverse_length_jvp(primals, tangents):
    i = inverse_length(*primals)
    change = (i / 2) * tangents[0]  # of r; i^3 by itself would overflow before i^2 does
    return i, -(i * i) * change


@jax.custom_jvp
def coefficient(square: Array, approach: Array, ks: Array, kd: Array, rest_length: Array) -> Array:
    """The force on the first end of a spring is c d, with d = p_i - p_j, r^2 = d.d and a = (v_i - v_j).d,

        c = (ks L - kd a / r) / r - ks

    At r = 0, c is the number -ks with all its derivatives 0 (see `apart`), so that for L = 0 the Jacobian there is
    -ks I. By r and not by `inverse_length`, which XLA would make a kernel of its own: a fifth of a forward run.
    """
    long = apart(square)
    r = jnp.sqrt(jnp.where(long, square, 1))
    return jnp.where(long, ks * rest_length - kd * (approach / r), 0) / r - ks


@coefficient.defjvp
def _coefficient_jvp(primals, tangents):
    """Written in i = 1 / r, which is computed once: what all derivatives share."""
    square, a, ks, kd, rest_length = primals
    i, a = inverse_length(square), stored(a)
    c = (ks * rest_length - kd * (a * i)) * i - ks
    by_r = (i * i) * (2 * kd * a * i - ks * rest_length)
    slopes = (by_r, -kd * (i * i), rest_length * i - 1, -a * (i * i), ks * i)
    changes = ((i / 2) * tangents[0], *tangents[1:])
    return c, dot(slopes, changes)


@component(static=("edges",), positive=("ks", "kd", "rest_length"))
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
    Raises: ValueError, if edges is not an integer (spring, 2) array or joins a particle to itself; in
      `simulate`, if an index is out of range, a parameter has another shape, or one that is not traced is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> spring = jeuler.Springs([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0)
      >>> spring(0.0, jnp.array([[0.0], [1.5]]), jnp.zeros((2, 1)), jnp.asarray(1.0)).tolist()
      [[5.0], [-5.0]]

    Source: D. Baraff, A. Witkin, Physically Based Modeling, SIGGRAPH course notes, 2001, particle systems, sect. 3.
    """

    edges: ParticleIndices
    ks: Parameter
    kd: Parameter
    rest_length: Parameter

    limits: ClassVar[dict[str, Any]] = {"ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m"), "rest_length": (">= 0", "m")}

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", Topology(self.edges))
        store_as_float(self, "ks", "kd", "rest_length")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return self.laid_out(len(position), position.dtype)(t, position, velocity, mass)

    def prepare(self, context: Any) -> PreparedSprings | None:
        """The springs between the living, laid out for the kernels; None where there are no springs."""
        if not len(self.edges):
            return None
        return self.laid_out(context.particles, context.dtype, context.limits_drag).prepare(context)

    def laid_out(self, particles: int, dtype: Any, read_again: bool = False) -> PreparedSprings:
        """The same force with its parameters in the slots of each layout, which is the same work at every step."""
        layouts = self.edges.layouts(particles)
        parameters = (x.astype(dtype) for x in (self.ks, self.kd, self.rest_length))
        slots = ([layout.to_slots(x) for layout in layouts] for x in parameters)
        return PreparedSprings(self.edges, layouts, read_again, *slots)

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy sum ks (r - L)^2 / 2, J."""
        ks, rest_length = (self._per_spring(x, position.dtype) for x in (self.ks, self.rest_length))
        r, _ = direction(self.edges.difference(position))
        return jnp.sum(ks * (r - rest_length) ** 2) / 2

    @staticmethod
    def _per_spring(x: Array, dtype: Any) -> Array:
        return x.astype(dtype)[:, None] if x.ndim else x.astype(dtype)

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        for name in ("ks", "kd", "rest_length"):
            shape = getattr(self, name).shape
            checks.shape(f"Springs.{name}", shape, (), (len(self.edges),), meaning="one a spring")
        check_limits(self)


@component(static=("edges", "layouts", "read_again"))
class PreparedSprings:
    """Springs as the kernels take them, with the parameters in the slots of each layout."""

    edges: Topology
    layouts: tuple[Layout, ...]
    read_again: bool  # see `Layout.central_force`
    ks: Any
    kd: Any
    rest_length: Any

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        x, v = split(position), split(velocity)
        total = [jnp.zeros_like(component) for component in x]
        for layout, *parameters in zip(self.layouts, self.ks, self.kd, self.rest_length, strict=True):
            shares = layout.central_force(coefficient, x, v, parameters, self.read_again)
            total = [a + b for a, b in zip(total, shares, strict=True)]
        return stack(total)

    def prepare(self, context: Any) -> PreparedSprings:
        """Between the living only: a spring with a dead end has no stiffness and no damping."""
        if context.alive is None:
            return self
        both = jnp.all(context.alive[self.edges[:]], axis=1)
        here = [layout.to_slots(both) for layout in self.layouts]

        def only_here(parameter):
            groups = [layout.by_group(x) for layout, x in zip(self.layouts, parameter, strict=True)]
            return jax.tree.map(lambda on, x: jnp.where(on, x, 0), here, groups)

        return replace(self, ks=only_here(self.ks), kd=only_here(self.kd))
