"""A soft body that remembers its shape."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices, default
from jeuler._core.component import component, store_as_float
from jeuler._core.indices import different_particles
from jeuler._core.limits import check_limits


@jax.custom_jvp
def rotation_of(a: Array) -> Array:
    """The rotation nearest to a square matrix: R in the polar decomposition A = R S with det R = 1.

    Its derivative is R W with W antisymmetric and S W + W S = R^T dA - dA^T R: finite also where singular values
    coincide, as they do in every undeformed cube, and where the derivative of the SVD is not.
    """
    u, _, vt = jnp.linalg.svd(a)
    flip = jnp.sign(jnp.linalg.det(u @ vt))
    return u.at[:, -1].multiply(flip) @ vt


@rotation_of.defjvp
def _rotation_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    (a,), (da,) = primals, tangents
    r = rotation_of(a)
    return r, r @ turning(r.T @ a, r.T @ da - da.T @ r)


def turning(s: Array, skew: Array) -> Array:
    """The antisymmetric W with S W + W S = skew, for a symmetric S, from its dim (dim - 1) / 2 unknowns alone.

        1/2 sum_kl (S W + W S)_kl B^a_kl = 1/2 sum_kl skew_kl B^a_kl,   W = sum_a w_a B^a,   B^a an antisymmetric basis

    In three dimensions the matrix of this equation is tr(S) I - S, the tensor of inertia, in two it is tr(S). It is
    singular where nothing tells the turning: a straight body about its line, a collapsed one about everything. The
    unknowns there are near 0 then: a small multiple of I is added, and its effect on the others removed by one step
    of iterative refinement.
    """
    basis = _antisymmetric_basis(len(s), s.dtype)
    matrix = jnp.einsum("akl,bkl->ab", basis, basis @ s + s @ basis) / 2
    right = jnp.einsum("akl,kl->a", basis, skew) / 2
    small = jnp.finfo(s.dtype).eps ** (2 / 3) * jnp.abs(jnp.trace(s)) + jnp.finfo(s.dtype).tiny ** 0.5
    safe = matrix + small * jnp.eye(len(basis), dtype=s.dtype)
    w = jnp.linalg.solve(safe, right)
    w = w + jnp.linalg.solve(safe, right - matrix @ w)
    return jnp.einsum("a,akl->kl", w, basis)


def _antisymmetric_basis(dim: int, dtype: Any) -> Array:
    """(dim (dim - 1) / 2, dim, dim), each with one entry 1 below the diagonal and -1 above it."""
    basis = np.zeros((dim * (dim - 1) // 2, dim, dim))
    for a, (k, l) in enumerate(itertools.combinations(range(dim), 2)):
        basis[a, l, k], basis[a, k, l] = 1, -1
    return jnp.asarray(basis, dtype)


@component(static=("particles",), positive=("stiffness", "damping"))
class ShapeMatching:
    """A soft body: each particle is pulled to its place in the rest shape, moved and turned as the body is now.

        c = mean of p,   R = the rotation nearest to sum_i (p_i - c) q_i^T,   g_i = c + R q_i
        F_i = stiffness (g_i - p_i) + damping (mean of v + W (p_i - c) - v_i)

    with q the rest shape about its own mean and W the turning of the body as it is, by least squares. The forces sum
    to zero and have no torque. A collapsed or inverted body finds back.

    Differentiable wherever one rotation is nearest: in flat bodies too (in two dimensions straight ones). Not
    differentiable, with derivatives that are finite and leave the undetermined turning out, where several are equally
    near: a body that has collapsed to a point, in three dimensions to a line, and an inverted one whose two smallest
    extents are equal.

    Args:
      particles: indices of the body, integers (body particle,). Static.
      rest_position: the rest shape, (body particle, dim), m. Differentiable.
      stiffness: (), N/m. Differentiable.
      damping: (), N s/m, of the motion within the body. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if the rest shape and the indices disagree, an index stands twice or a number is
      negative; in `simulate`, if an index is out of range.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> square = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
      >>> body = jeuler.ShapeMatching(range(4), square, stiffness=10.0)
      >>> turned = square @ jnp.array([[0.0, 1.0], [-1.0, 0.0]]) + 5.0
      >>> bool(jnp.abs(body(0.0, turned, 0 * turned, jnp.asarray(1.0))).max() < 1e-4)
      True

    Source: M. Mueller, B. Heidelberger, M. Teschner, M. Gross, Meshless Deformations Based on Shape Matching, 2005.
    """

    particles: ParticleIndices
    rest_position: Parameter
    stiffness: Parameter
    damping: Parameter = default(0.0)

    limits: ClassVar[dict[str, Any]] = {
        "rest_position": ("", "m"),
        "stiffness": (">= 0", "N/m"),
        "damping": (">= 0", "N s/m"),
    }
    axes: ClassVar[dict[str, int]] = {"stiffness": 0, "damping": 0}

    def __post_init__(self) -> None:
        object.__setattr__(self, "particles", different_particles("ShapeMatching.particles", self.particles))
        store_as_float(self, "rest_position", "stiffness", "damping")
        if self.rest_position.ndim != 2 or len(self.rest_position) != len(self.particles):
            raise ValueError(
                f"ShapeMatching.rest_position must have shape ({len(self.particles)}, dim), one place for each of the "
                f"body's particles, got {self.rest_position.shape}"
            )
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, *, alive: Array | None = None) -> Array:
        body, dtype = np.asarray(self.particles), position.dtype
        here = jnp.ones(len(body), dtype) if alive is None else alive[body].astype(dtype)
        here = here[:, None]

        def about_mean(x):
            return here * (x - jnp.sum(here * x, axis=0) / jnp.maximum(jnp.sum(here), 1))

        p, v, q = (about_mean(x) for x in (position[body], velocity[body], self.rest_position.astype(dtype)))
        # a body within rounding of one point has no turning: its derivative there would be that of the rounding
        extent = 32 * jnp.finfo(dtype).eps * jnp.max(jnp.abs(position[body]), initial=0)
        a = jnp.where(jnp.max(jnp.abs(p), initial=0) > extent, p.T @ q, lax.stop_gradient(p.T @ q))
        arm = jnp.where(jnp.max(jnp.abs(p), initial=0) > extent, p, 0)
        turn = turning(arm.T @ arm, v.T @ arm - arm.T @ v)
        to_goal, to_rigid = q @ rotation_of(a).T - p, p @ turn.T - v
        force = self.stiffness.astype(dtype) * to_goal + self.damping.astype(dtype) * to_rigid
        return jnp.zeros_like(position).at[body].add(force)

    def prepare(self, context: Any) -> Callable[..., Array]:
        """The body of the living only."""
        return self if context.alive is None else functools.partial(self, alive=context.alive)

    def check(self, particles: int, dim: int) -> None:
        checks.indices("ShapeMatching.particles", self.particles, particles, "particle indices")
        checks.shape("ShapeMatching.rest_position", self.rest_position.shape, (len(self.particles), dim))
