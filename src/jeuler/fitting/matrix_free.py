"""Levenberg-Marquardt for many unknowns: products with the Jacobian and its transpose, and no Jacobian.

The linear problem of each step is solved by conjugate gradients (`lineax.CG`). optimistix's Levenberg-Marquardt can be
given that solver too, but not bounds, nor a scale for each unknown, without which such a solver hardly converges here.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.fitting.least_squares import Task, start
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minimise import progress_bar
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import FlatResidual, Problem
from jeuler.fitting.report import NOT_FINITE, report
from jeuler.fitting.result import Fit

PROBES = 8  # random directions that estimate the norms of the columns
MOST_PRODUCTS = 150  # iterations of conjugate gradients in one step
ACCURACY = 1e-2  # of a step, relative
NEAR = 0.05  # standard errors, root mean square over the unknowns: such a step is the last


class Products(NamedTuple):
    """The compiled programs of a residual."""

    cost: Any
    norms: Any
    step: Any


@functools.lru_cache(maxsize=8)
def _products(residual: FlatResidual, loss: str) -> Products:
    """Cost, norms of columns and damped step of a residual; kept, so that a fit of the same shape uses them again."""
    import lineax

    rho = LOSSES[loss]

    def weighted(x: Array, task: Task) -> Array:
        return jnp.where(task.weights > 0, residual(x, task.data) * task.weights, 0)

    def bent(x: Array, task: Task) -> tuple[Array, Array]:
        r = weighted(x, task)
        return r, rho(r / task.spread)[1]

    @jax.jit
    def cost(x: Array, task: Task) -> tuple[Array, Array, Array]:
        r = weighted(x, task)
        return jnp.sum(rho(r / task.spread)[0]) * task.spread**2, jnp.sum(r**2), r

    @jax.jit
    def norms(x: Array, task: Task) -> Array:
        r, slope = bent(x, task)
        _, transpose = jax.vjp(lambda x: weighted(x, task), x)
        signs = jax.random.rademacher(jax.random.key(0), (PROBES, len(r)), x.dtype)
        return jnp.sqrt(jax.lax.map(lambda sign: transpose(slope * sign)[0] ** 2, signs).mean(axis=0))

    @jax.jit
    def step(x: Array, task: Task, scale: Array, held: Array, damping: Array) -> tuple[Array, Array, Array]:
        r, slope = bent(x, task)
        function = lambda x: weighted(x, task)  # noqa: E731  # read twice below
        _, transpose = jax.vjp(function, x)
        unit = jnp.where(held, 0, 1 / scale)

        def normal(s: Array) -> Array:
            _, change = jax.jvp(function, (x,), (unit * s,))
            return unit * transpose(slope**2 * change)[0] + jnp.where(held, 1, damping) * s

        gradient = transpose(slope**2 * r)[0]
        form = jax.ShapeDtypeStruct(x.shape, x.dtype)
        operator = lineax.FunctionLinearOperator(normal, form, lineax.positive_semidefinite_tag)
        solver = lineax.CG(rtol=ACCURACY, atol=0.0, max_steps=MOST_PRODUCTS)
        solution = lineax.linear_solve(operator, -unit * gradient, solver, throw=False).value
        _, change = jax.jvp(function, (x,), (unit * solution,))
        decrease = -(2 * jnp.sum(gradient * unit * solution) + jnp.sum((slope * change) ** 2))
        return unit * solution, decrease, gradient

    return Products(cost, norms, step)


def run_matrix_free(problem: Problem, options: Options, known: Known) -> Fit:
    """The fit of a problem whose Jacobian is not formed; standard errors are not computed."""
    if options.starts is not None or options.resume is not None:
        raise ValueError(
            f"starts and resume are for up to {problem.form.size * len(problem.x) * 8 / 2**30:.1g} GB of Jacobian; "
            f"leave them out for {len(problem.x)} unknowns"
        )
    task = problem.task(options.tolerance)
    spread = options.loss_scale if options.loss_scale is not None else 1.345 * (known.noise or 1.0)
    task = task._replace(spread=np.asarray(spread if options.loss != "linear" else 1.0))
    products = _products(problem.residual, options.loss)
    x = np.asarray(problem.x, float)
    history: list[float] = []
    nonfinite, words, r = 0, "", np.zeros(problem.form.size)
    total = np.inf
    with progress_bar(options.progress, options.max_iterations) as bar:
        for mask in (*problem.stages, task.all_weights):
            try:
                x, total, r, lost, words = _descend(products, x, task._replace(weights=mask), options, history, bar)
            except KeyboardInterrupt:
                if not history:
                    raise
                words = "interrupted: the best so far"
            nonfinite += lost
            if words.startswith("interrupted"):
                break
    if not np.isfinite(total):
        raise ValueError(NOT_FINITE)
    state = start(x, problem.form.size, 1)
    state = state._replace(
        total=np.asarray(total), residual=r, nonfinite=np.asarray(nonfinite), jacobian=np.zeros((0, 0))
    )
    more = (*known.more, f"standard errors are not computed for {len(x)} unknowns")
    told = Known(known.variance, known.noise, more)
    return report(problem, state, history, 1.0, options.loss, words, told)


def _descend(
    products: Products, x: np.ndarray, task: Task, options: Options, history: list[float], bar: Any
) -> tuple[np.ndarray, float, np.ndarray, int, str]:
    """Damped steps to the minimum: the point, its sum of squares, its residual, and how it ended."""
    cost, total, r = (np.asarray(a, float) for a in products.cost(x, task))
    if not np.isfinite(cost):
        return x, np.inf, r, 1, "the residual is not finite"
    norms = np.asarray(products.norms(x, task), float)
    scale = np.where(norms > 1e-6 * norms.max(initial=0), norms, max(norms.max(initial=0), 1e-300))
    held, damping, growth, lost = np.zeros(len(x), bool), 0.0, 2.0, 0
    freedom = max(int(np.sum(task.weights > 0)) - len(x), 1)
    for _ in range(options.max_iterations):
        step, decrease, gradient = (
            np.asarray(a, float) for a in products.step(x, task, scale, held, np.asarray(damping))
        )
        free = ~(((x <= task.lower) & (gradient > 0)) | ((x >= task.upper) & (gradient < 0)))
        if (free == held).any():  # another set is held at its bounds: solve with that one
            held = ~free
            step, decrease, gradient = (
                np.asarray(a, float) for a in products.step(x, task, scale, held, np.asarray(damping))
            )
        trial = np.clip(x + step, task.lower, task.upper)
        offset = np.sqrt(max(float(decrease), 0) / len(x) / (max(float(cost - decrease), 1e-300) / freedom))
        there = [np.asarray(a, float) for a in products.cost(trial, task)]
        lost += not np.isfinite(there[0])
        gain = (cost - there[0]) / max(float(decrease), 1e-300)
        if np.isfinite(there[0]) and there[0] < cost and gain > (1e-3 if damping else 0.1):
            x, (cost, total, r) = trial, there
            damping, growth = damping * (0.1 if gain > 0.75 else 0.5), 2.0
            damping = damping if damping > 1e-6 else 0.0
            history.append(float(total))
            bar.update()
            if offset <= NEAR and gain > 0.5:
                return x, float(total), r, lost, "converged"
        else:
            if decrease <= 1e2 * float(task.precision) * cost or offset <= NEAR:
                return x, float(total), r, lost, "converged"
            damping, growth = max(damping * growth, 1e-3), growth * 2
            if growth > 1e12:
                break
    return x, float(total), r, lost, "stopped before it converged: allow more iterations or start closer"
