"""The solvers of one implicit step: Newton's method, what to do where it fails, and the linear solves within.

Newton's method is optimistix's and the linear solvers are lineax's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

NEAR = 1e-2  # a damped step of this part of the unknowns: Newton's method can take over
DENSE_UP_TO = 128  # unknowns: below, a dense LU factorisation is faster than Krylov iterations


class StepInfo(NamedTuple):
    """How an implicit step was solved: whether it converged, in how many iterations, damped ones included."""

    converged: Array
    iterations: Array


def newton_then_damped(*, rtol: float, max_steps: int, damped_steps: int, linear_solver: Any) -> Callable:
    """``solve(residual, guess) -> (root, StepInfo)``, in units of the absolute tolerance.

    Newton's method; where it does not converge, `damped_steps` of the way down from the guess, and Newton's again.
    Both rounds are the same pass of one loop, so that a batch runs the second only if one of its members needs it.
    """

    def solve(residual, guess):
        def search(state):
            _, info, n = state
            start, steps = descend(residual, guess, jnp.where(n == 0, 0, damped_steps), linear_solver)
            z, found = newton(residual, start, rtol, max_steps, linear_solver)
            return z, StepInfo(found.converged, info.iterations + steps + found.iterations), n + 1

        rounds = jnp.where(jnp.all(jnp.isfinite(guess)) & (damped_steps > 0), 2, 1)
        none = StepInfo(jnp.asarray(False), jnp.int32(0))
        z, info, _ = lax.while_loop(lambda s: ~s[1].converged & (s[2] < rounds), search, (guess, none, jnp.int32(0)))
        return z, info

    return solve


def descend(residual: Callable[[Array], Array], guess: Array, limit: Any, linear_solver: Any) -> tuple[Array, Array]:
    """Follow z' = -residual(z) from the guess, by linearly implicit steps h that grow as it nears a root.

        (I / h + J) d = -residual(z),   z + d kept where |residual(z + d) + d / h| < |d / h|: the step is that of the
        nonlinear equation then, half of it at least; h is 4 times as long after it, and a quarter otherwise

    Where forces have a potential, it ends in a valley of that of the step; Newton's method may go to a pass or wander.

    Returns: the pair (z, the number of steps).
    Source: C. T. Kelley, D. E. Keyes, Convergence Analysis of Pseudo-Transient Continuation, SIAM J. Numer. Anal. 35,
      1998, eq. 1.3.
    """
    import lineax

    def step(state):
        z, h, _, n = state
        value, slope = jax.linearize(residual, z)
        operator = lineax.FunctionLinearOperator(lambda d: d / h + slope(d), jax.eval_shape(lambda: z))
        d = -lineax.linear_solve(operator, value, linear_solver, throw=False).value
        arrived = (h > 1) & (jnp.max(jnp.abs(d)) <= 1 + NEAR * jnp.max(jnp.abs(z)))
        kept = arrived | (jnp.linalg.norm(residual(z + d) + d / h) < jnp.linalg.norm(d / h))
        return jnp.where(kept, z + d, z), jnp.where(kept, 4 * h, h / 4), arrived, n + 1

    start = guess, jnp.asarray(1e-3, guess.dtype), jnp.asarray(False), jnp.int32(0)
    z, _, _, n = lax.while_loop(lambda s: ~s[2] & (s[3] < limit), step, start)
    return z, n


@functools.cache
def _newton_class() -> Any:
    import optimistix

    class Newton(optimistix.Newton):
        """Newton's method that ends when the correction is small.

        optimistix asks that the residual be small too, which rounding forbids where dt |J| is large.
        """

        def terminate(self, fn, y, args, options, state, tags):
            failed = state.result != optimistix.RESULTS.successful
            return failed | (state.diffsize <= 1), state.result

    return Newton


def newton(residual: Callable, guess: Array, rtol: float, max_steps: int, linear_solver: Any) -> tuple[Array, StepInfo]:
    import optimistix

    solver = _newton_class()(rtol=rtol, atol=1.0, linear_solver=linear_solver)
    solution: Any = optimistix.root_find(lambda z, args: residual(z), solver, guess, max_steps=max_steps, throw=False)
    converged = solution.result == optimistix.RESULTS.successful
    return solution.value, StepInfo(jnp.asarray(converged), solution.stats["num_steps"].astype(jnp.int32))


def linear_solver_for(like: Array, *, rtol: float, atol: float) -> Any:
    """LU for few unknowns, BiCGStab without a matrix for many."""
    import lineax

    return lineax.LU() if like.size <= DENSE_UP_TO else lineax.BiCGStab(rtol=rtol, atol=atol)


def solve_linear(matvec: Callable[[Array], Array], b: Array, *, solver: Any) -> Array:
    """x with matvec(x) = b, close to roundoff; NaN where the solver fails. Differentiable to any order."""
    import lineax

    tolerance = 1e-12 if b.dtype == jnp.float64 else 1e-6
    solver = solver or linear_solver_for(b, rtol=tolerance, atol=tolerance)

    def solve(matvec, b):
        size = jnp.max(jnp.abs(b))
        size = jnp.where(size > 0, size, 1)
        operator = lineax.FunctionLinearOperator(matvec, jax.eval_shape(lambda: b))
        solution = lineax.linear_solve(operator, b / size, solver, throw=False)
        solved = solution.result == lineax.RESULTS.successful
        return solution.value * size * jnp.where(solved, 1, jnp.nan)

    return lax.custom_linear_solve(matvec, b, solve, solve)
