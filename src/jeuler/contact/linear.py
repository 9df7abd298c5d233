"""Linear equations of the contacts at rest, by least squares: some have no answer, some several."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

DENSE_UP_TO = 96  # unknowns that are solved for by a matrix
ITERATIONS = 400
REFINEMENTS = 3


def solve_linear(slope: Callable[[Array], Array], b: Array) -> Array:
    """slope^-1 b, by least squares; where contacts are redundant, some forces that do the same."""
    if b.size > DENSE_UP_TO:
        return lax.custom_linear_solve(slope, b, conjugate_gradients, transpose_solve=conjugate_gradients)
    matrix = matrix_of(slope, b)

    def solver(m):
        return lambda _, b: least_squares(m)(b[:, None])[:, 0]

    fixed = lax.stop_gradient(matrix)
    solved = lax.custom_linear_solve(lambda d: matrix @ d, b.ravel(), solver(fixed), transpose_solve=solver(fixed.T))
    return solved.reshape(b.shape)


def matrix_of(slope: Callable[[Array], Array], like: Array) -> Array:
    """The matrix of a linear function of arrays like this one."""
    one_each = jnp.eye(like.size, dtype=like.dtype)
    return jax.vmap(lambda d: slope(d.reshape(like.shape)).ravel())(one_each).T


def least_squares(m: Array) -> Callable[[Array], Array]:
    """b, (unknown, column), to the shortest x that makes |m x - b| least."""
    small = 1e3 * jnp.finfo(m.dtype).eps * jnp.eye(len(m), dtype=m.dtype)
    half = lax.linalg.cholesky(m.T @ m + small)

    def solve(b):
        def refine(_, x):
            y = lax.linalg.triangular_solve(half, m.T @ (b - m @ x), left_side=True, lower=True)
            return x + lax.linalg.triangular_solve(half, y, left_side=True, lower=True, transpose_a=True)

        return lax.fori_loop(0, 1 + REFINEMENTS, refine, jnp.zeros_like(b))

    return solve


def conjugate_gradients(matvec: Callable[[Array], Array], b: Array) -> Array:
    """x that makes |matvec(x) - b| least, by conjugate gradients on the normal equations; it does not need an inverse.

    Source: A. Bjorck, Numerical Methods for Least Squares Problems, 1996, sect. 7.4.1 (CGLS).
    """
    transposed = jax.linear_transpose(matvec, b)

    def one(state):
        x, r, p, size, k = state
        change = matvec(p)
        alpha = size / jnp.sum(change**2)
        x, r = x + alpha * p, r - alpha * change
        (s,) = transposed(r)
        new = jnp.sum(s**2)
        return x, r, s + new / size * p, new, k + 1

    (s,) = transposed(b)
    first = jnp.sum(s**2)
    enough = jnp.maximum(1e-10, jnp.finfo(b.dtype).eps) ** 2 * first
    state = jnp.zeros_like(b), b, s, first, 0
    return lax.while_loop(lambda state: (state[3] > enough) & (state[4] < ITERATIONS), one, state)[0]
