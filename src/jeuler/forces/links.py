"""Springs with a law of their own: cubic, that only pull, or that break."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, ParticleIndices, default
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler._core.vectors import apart, direction
from jeuler.forces.prepared import PreparedLinks, check_box, in_box
from jeuler.forces.springs import coefficient
from jeuler.graphs.topology import topology


def cubic_coefficient(square: Array, approach: Array, ks: Array, kd: Array, rest_length: Array, cubic: Array) -> Array:
    """The number c of a force c d on the first end, with s = r - L: c = -(ks s + cubic s^3 + kd a / r) / r."""
    long = apart(square)
    r = jnp.sqrt(jnp.where(long, square, 1))
    return jnp.where(long, ks * rest_length - cubic * (r - rest_length) ** 3 - kd * (approach / r), 0) / r - ks


def string_coefficient(square: Array, approach: Array, ks: Array, kd: Array, rest_length: Array) -> Array:
    """c = -T / r with the tension T = ks (r - L) + kd a / r where r > L and T > 0, else 0."""
    long = apart(square)
    r = jnp.sqrt(jnp.where(long, square, 1))
    tension = ks * (r - rest_length) + kd * (approach / r)
    return jnp.where(long & (r > rest_length) & (tension > 0), -tension / r, 0)


class _Links:
    """What the links share."""

    edges: Any
    rest_length: Any
    box: Any
    law: ClassVar[Callable[..., Array]]
    names: ClassVar[tuple[str, ...]] = ("ks", "kd", "rest_length")
    limits: ClassVar[dict[str, Any]] = {
        "ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m"), "rest_length": (">= 0", "m"), "box": ("> 0", "m"),
    }  # fmt: skip

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", topology(self.edges))
        store_as_float(self, *self.names, "box")

    def prepare(self, context: Any) -> PreparedLinks | None:
        """The links between the living, laid out for the kernels; None where there are none."""
        if not len(self.edges):
            return None
        return self.laid_out(context.particles, context.dtype, context.limits_drag).prepare(context)

    def laid_out(self, particles: int, dtype: Any, read_again: bool = False) -> PreparedLinks:
        layouts = self.edges.layouts(particles, shifts=self.box is None)
        values = [getattr(self, name).astype(dtype) for name in self.names]
        slots = [[layout.to_slots(x) for layout in layouts] for x in values]
        law, box = type(self).law, in_box(self.box, dtype)
        return PreparedLinks(self.edges, layouts, law, self.names, read_again, slots, box)

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        for name in self.names:
            where = f"{type(self).__name__}.{name}"
            checks.shape(where, getattr(self, name).shape, (), (len(self.edges),), meaning="one a link")
        check_box(self, dim)
        check_limits(self)

    def _stretch(self, position: Array) -> Array:
        r, _ = direction(self.edges.difference(position, in_box(self.box, position.dtype)))
        return r[:, 0] - self.rest_length.astype(position.dtype)


class _LastingLinks(_Links):
    """Links that no state breaks."""

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return self.laid_out(len(position), position.dtype)(t, position, velocity, mass)


@component(static=("edges",), parameters=("ks", "kd", "rest_length", "cubic"), positive=("ks", "kd", "rest_length"))
class CubicSprings(_LastingLinks):
    """Springs that grow stiffer, or softer, as they are stretched (Duffing's), with dampers.

        s = r - L,   F_i = -(ks s + cubic s^3) u - kd ((v_i - v_j).u) u,   F_j = -F_i

    Args:
      edges: the two particles (i, j) of each spring, integers (spring, 2). Static.
      ks: stiffness at rest length, () or (spring,), N/m. Differentiable.
      kd: damping, () or (spring,), N s/m. Differentiable.
      rest_length: L, () or (spring,), m. Differentiable.
      cubic: () or (spring,), N/m^3; above 0 hardens, below 0 softens. Differentiable.
      box: (dim,), m, the sides of periodic space, as for `Springs`; None for free space. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if edges is not an integer (spring, 2) array; in `simulate`, if an index is out of range, a
      parameter has another shape, or ks, kd or rest_length is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> spring = jeuler.CubicSprings([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0, cubic=2.0)
      >>> spring(0.0, jnp.array([[0.0], [3.0]]), jnp.zeros((2, 1)), jnp.asarray(1.0)).tolist()
      [[36.0], [-36.0]]

    Source: G. Duffing, Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz, 1918.
    """

    edges: ParticleIndices
    ks: Parameter
    kd: Parameter
    rest_length: Parameter
    cubic: Parameter
    box: OptionalParameter = default(None)

    law: ClassVar[Callable[..., Array]] = staticmethod(cubic_coefficient)
    names: ClassVar[tuple[str, ...]] = ("ks", "kd", "rest_length", "cubic")
    limits: ClassVar[dict[str, Any]] = {**_Links.limits, "cubic": ("", "N/m^3")}

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy sum ks s^2 / 2 + cubic s^4 / 4, J."""
        s = self._stretch(position)
        return jnp.sum(self.ks.astype(s.dtype) * s**2 / 2 + self.cubic.astype(s.dtype) * s**4 / 4)


@component(static=("edges",), parameters=("ks", "kd", "rest_length"), positive=("ks", "kd", "rest_length"))
class Strings(_LastingLinks):
    """Strings: they pull where they are longer than their rest length, and are slack where they are shorter.

        T = ks (r - L) + kd (v_i - v_j).u   where r > L and T > 0, else 0;   F_i = -T u,   F_j = -F_i

    A damper does not make a string push.

    Args:
      edges: the two particles (i, j) of each string, integers (string, 2). Static.
      ks: stiffness, () or (string,), N/m. Differentiable.
      kd: damping, () or (string,), N s/m. Differentiable.
      rest_length: L, () or (string,), m. Differentiable.
      box: (dim,), m, the sides of periodic space, as for `Springs`; None for free space. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if edges is not an integer (string, 2) array; in `simulate`, if an index is out of range, or a
      parameter has another shape or is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> string = jeuler.Strings([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0)
      >>> [string(0.0, jnp.array([[0.0], [x]]), jnp.zeros((2, 1)), jnp.asarray(1.0))[0, 0].item() for x in (0.5, 1.5)]
      [0.0, 5.0]
    """

    edges: ParticleIndices
    ks: Parameter
    kd: Parameter
    rest_length: Parameter
    box: OptionalParameter = default(None)

    law: ClassVar[Callable[..., Array]] = staticmethod(string_coefficient)

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy of the strings that are taut, sum ks (r - L)^2 / 2, J."""
        s = jnp.maximum(self._stretch(position), 0)
        return jnp.sum(self.ks.astype(s.dtype) * s**2) / 2


@component(static=("edges",), parameters=("ks", "kd", "rest_length"), positive=("ks", "kd", "rest_length"))
class BreakableSprings(_Links):
    """Springs with dampers that are gone once they are broken: `Breaking` says which are.

        F_i = ks (L - r) u - kd ((v_i - v_j).u) u where the spring holds, else 0;   F_j = -F_i

    Args:
      edges: the two particles (i, j) of each spring, integers (spring, 2). Static.
      ks: stiffness, () or (spring,), N/m. Differentiable.
      kd: damping, () or (spring,), N s/m. Differentiable.
      rest_length: L, () or (spring,), m. Differentiable.
      box: (dim,), m, the sides of periodic space, as for `Springs`; None for free space. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass, broken)``, the force on each particle, (particle, dim),
      N; broken is (1, spring), boolean.
    Raises: ValueError, in `simulate`, if the scene has no `Breaking` with as many springs, an index is out of range, or
      a parameter has another shape or is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState([[0.0], [1.0]], [[0.0], [4.0]], mass=[jnp.inf, 1.0])
      >>> rope = jeuler.BreakableSprings([[0, 1]], ks=1.0, kd=0.0, rest_length=1.0)
      >>> scene = jeuler.Scene((rope,), (jeuler.Breaking(rope, max_strain=0.5),))
      >>> run = jeuler.simulate(scene, state, dt=0.25, num_steps=3, step=jeuler.symplectic_euler_step)
      >>> run.y.position[:, 1, 0].tolist(), run.y.broken_springs.tolist()  # free from the first step on
      ([1.0, 2.0, 3.0, 4.0], [0, 1, 1, 1])
    """

    edges: ParticleIndices
    ks: Parameter
    kd: Parameter
    rest_length: Parameter
    box: OptionalParameter = default(None)

    law: ClassVar[Callable[..., Array]] = staticmethod(coefficient)
    reads: ClassVar[tuple[str, ...]] = ("broken",)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, broken: Array) -> Array:
        return self.laid_out(len(position), position.dtype)(t, position, velocity, mass, broken)
