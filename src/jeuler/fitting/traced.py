"""A fit as part of a larger program: under jit, vmap and grad."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler.fitting import least_squares
from jeuler.fitting.descent_traced import descended
from jeuler.fitting.evaluate import evaluations
from jeuler.fitting.least_squares import State, Task, advance, again, start
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minimise import ROUGH, TUNING
from jeuler.fitting.options import Options
from jeuler.fitting.problem import Problem
from jeuler.fitting.report import errors_of
from jeuler.fitting.result import Fit


def run_traced(problem: Problem, options: Options, scale: Any = None) -> Fit:
    """The fit of traced values. Words cannot be made of them: ``message`` says where to look."""
    for name in ("minibatch", "starts", "resume"):
        if getattr(options, name) is not None:
            raise ValueError(f"{name} must be None where the fit is traced, under jit, vmap or grad")
    if options.loss != "linear" and options.loss_scale is None and not problem.absolute:
        raise ValueError("loss_scale must be given where a fit with a robust loss is traced, under jit, vmap or grad")
    x = jnp.asarray(problem.x)
    task = problem.task(options.tolerance)
    spread = TUNING if options.loss_scale is None else options.loss_scale
    task = task._replace(spread=jnp.asarray(spread, x.dtype))
    # what the residual closes over becomes an argument, so that derivatives by it are seen
    pure, consts = jax.closure_convert(lambda x, data: problem.residual(x, data), x, task.data)
    task = task._replace(data=(task.data, tuple(consts)))

    def residual(x: Array, data: Any) -> Array:
        return pure(x, data[0], *data[1])

    unit = None if options.optimizer is None else jnp.asarray(problem.layout.spread("scale", scale, 1.0))
    state = _search(residual, problem, options, unit, lax.stop_gradient(x), lax.stop_gradient(task))
    gradient = functools.partial(_gradient, residual, LOSSES[options.loss])
    best = _optimum(gradient, state.x, task)
    raw = residual(best, task.data)
    weighted = jnp.where(task.all_weights > 0, raw * task.all_weights, 0)
    size = jnp.maximum(jnp.sum(task.all_weights > 0), 1)
    held = task.lower >= task.upper
    state = state._replace(jacobian=jnp.where(held, 0, state.jacobian))
    found = errors_of(problem, state, task.spread, options.loss)
    error, white = (
        jnp.where(held, 0, jnp.where(found.blind, jnp.inf, jnp.sqrt(jnp.maximum(jnp.diag(c), 0))))
        for c in (found.covariance, found.white)
    )
    layout = problem.layout
    return Fit(
        params=layout.params(best),
        loss=jnp.sum(weighted**2) / size,
        history=state.history / size,
        stderr=layout.params(error),
        covariance=found.covariance,
        converged=(state.status == least_squares.CONVERGED) | (state.status == least_squares.ROUNDED),
        message="found while traced: read converged, stderr, autocorrelation and nonfinite",
        undetermined=(),
        nonfinite=state.nonfinite,
        stderr_white=layout.params(white),
        residual=problem.of_data(weighted),
        noise_ratio=jnp.sqrt(jnp.sum(weighted**2) / size) if problem.absolute else None,
        autocorrelation=found.autocorrelation,
    )


def _search(
    residual: Callable[..., Any], problem: Problem, options: Options, unit: Array | None, x: Array, task: Task
) -> State:
    """Through the stages in one scan, then over everything; ``unit`` is that of an optax optimiser."""
    evaluate, never = evaluations(residual, compiled=False), jnp.iinfo(jnp.int32).max
    state = start(jnp.clip(x, task.lower, task.upper), len(task.weights), options.max_iterations)
    if unit is not None:
        return descended(evaluate, problem.stages, options, lax.stop_gradient(unit), state, task)
    if problem.stages:
        rough = task._replace(tolerance=jnp.asarray(ROUGH, x.dtype))

        def stage(state: State, weights: Array) -> tuple[State, None]:
            some = rough._replace(weights=weights)
            return again(advance(evaluate, LOSSES["linear"], state, some, never)), None

        weights = jnp.stack([jnp.asarray(w, x.dtype) for w in problem.stages])
        state, _ = lax.scan(stage, state, lax.stop_gradient(weights))
    return advance(evaluate, LOSSES[options.loss], state, task, never)


def _gradient(residual: Callable[..., Any], loss: Any, x: Array, task: Task) -> Array:
    """The gradient of the cost that is minimised."""

    def cost(x: Array) -> Array:
        weighted = jnp.where(task.all_weights > 0, residual(x, task.data) * task.all_weights, 0)
        return jnp.sum(loss(weighted / task.spread)[0]) * task.spread**2

    return jax.grad(cost)(x)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _optimum(gradient: Callable[..., Any], x: Array, task: Task) -> Array:
    """x, whose derivative is that of the point where the gradient is zero:

    dx = -H^-1 d(gradient),   H = d gradient / dx,   over what is not on a bound
    """
    return x


@_optimum.defjvp
def _optimum_jvp(gradient, primals, tangents):
    (x, task), (_, moving) = primals, tangents
    slope = gradient(x, task)
    held = ((x <= task.lower) & (slope > 0)) | ((x >= task.upper) & (slope < 0))
    hessian = jax.jacfwd(gradient)(x, task)
    _, change = jax.jvp(lambda task: gradient(x, task), (task,), (moving,))
    free = ~held[:, None] & ~held[None, :]
    hessian = jnp.where(free, hessian, jnp.eye(len(x), dtype=x.dtype))
    size = jnp.sqrt(jnp.maximum(jnp.abs(jnp.diag(hessian)), jnp.finfo(x.dtype).tiny))
    scaled = hessian / size[:, None] / size[None, :]
    step = -jnp.linalg.solve(scaled, jnp.where(held, 0, change) / size) / size
    return x, jnp.where(held, 0, step)
