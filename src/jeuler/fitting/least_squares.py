"""Levenberg-Marquardt between bounds, run in two ways: NumPy around a compiled residual, or JAX throughout.

With values in hand the linear algebra is that of NumPy in float64: nothing of it is compiled, which would take longer
than most fits. Under jit, vmap and grad the same lines are a loop of JAX.

Why not optimistix.LevenbergMarquardt: its damping is that of the unit matrix in the units of the parameters, it has no
bounds, and it stops by the size of a step, so that a small start or another unit changes the answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.factors import namespace, projected

RUNNING, CONVERGED, ROUNDED, STALLED, NOT_FINITE = range(5)
TRUSTED = 0.25  # the share of the predicted decrease that a step without damping must keep
ACCEPTED = 1e-3  # and one with damping

Loss = Any  # of `losses`
Numbers = Any  # an array of NumPy or of JAX


def _while(goes_on: Callable[[Any], Any], body: Callable[[Any], Any], carry: Any, xp: Any) -> Any:
    """``lax.while_loop``, or the same in Python."""
    if xp is jnp:
        return lax.while_loop(goes_on, body, carry)
    while goes_on(carry):
        carry = body(carry)
    return carry


class Task(NamedTuple):
    """What a search is given: all of it may be traced.

    Attributes:
      data: what the residual reads beside the parameters.
      weights: what each residual is multiplied with, 1 / sigma for a known error; 0 leaves it out, (m,).
      all_weights: the same for the whole of the data, where ``weights`` count a part of it.
      lower, upper: bounds, (n,).
      spread: the size of a residual times its weight beyond which a robust loss bends, ().
      tolerance: distance to the minimum, in standard errors, at which it has converged, ().
      precision: unit roundoff of the residual's arithmetic, ().
      enough: a cost at which to stop: that of the noise, where a part of the data would not say more, ().
    """

    data: Any
    weights: Numbers
    all_weights: Numbers
    lower: Numbers
    upper: Numbers
    spread: Numbers
    tolerance: Numbers
    precision: Numbers
    enough: Numbers


class State(NamedTuple):
    """Where a search is."""

    x: Numbers
    cost: Numbers  # sum of the losses of what counts
    total: Numbers  # sum of squares over everything
    residual: Numbers  # weighted
    bent: Numbers  # the same as the quadratic model of a robust loss sees it
    jacobian: Numbers
    scale: Numbers  # the largest norm of each column so far
    damping: Numbers
    growth: Numbers
    trial: Numbers
    predicted: Numbers  # decrease of the cost at the trial
    status: Numbers
    iterations: Numbers
    nonfinite: Numbers
    evaluations: Numbers
    before: Numbers  # evaluations before this search began
    history: Numbers
    offset: Numbers  # distance to the minimum in standard errors, by the linear model


def start(x: Any, m: int, max_iterations: int) -> State:
    """The state before anything has been evaluated."""
    xp, n = namespace(x), len(x)
    number = xp.zeros((), x.dtype)
    count = xp.zeros((), xp.int32)
    return State(
        x=x,
        cost=number + xp.inf,
        total=number + xp.inf,
        residual=xp.zeros(m, x.dtype),
        bent=xp.zeros(m, x.dtype),
        jacobian=xp.zeros((m, n), x.dtype),
        scale=xp.zeros(n, x.dtype),
        damping=number,
        growth=number + 2,
        trial=x,
        predicted=number + xp.inf,
        status=count + RUNNING,
        iterations=count,
        nonfinite=count,
        evaluations=count,
        before=count,
        history=xp.full(max_iterations, xp.nan, x.dtype),
        offset=number + xp.inf,
    )


def again(state: State) -> State:
    """The same point as the start of a search with other weights."""
    fresh = start(state.x, len(state.residual), len(state.history))
    return fresh._replace(nonfinite=state.nonfinite, evaluations=state.evaluations, before=state.evaluations)


def advance(evaluate: Evaluate, loss: Loss, state: State, task: Task, until: Any) -> State:
    """Go on with a search until it ends or has made ``until`` evaluations in all.

        minimise  sum_k rho(w_k r_k(x)),   lower <= x <= upper
        (J^T J + damping D^2) s = -J^T r,   D_i = the largest |J_i| so far

    Source: J. J. More, The Levenberg-Marquardt algorithm: implementation and theory, 1978 (scaling by columns);
      D. M. Bates, D. G. Watts, Technometrics 23, 1981, 179 (the convergence criterion).
    """

    def goes_on(state: State) -> Any:
        return (state.status == RUNNING) & (state.evaluations < until) & (state.iterations < len(state.history))

    def iterate(state: State) -> State:
        return _iterate(evaluate, loss, state, task)

    return _while(goes_on, iterate, state, namespace(state.x))


def _iterate(evaluate: Evaluate, loss: Loss, state: State, task: Task) -> State:
    """Evaluate the trial point, take it or not, and find the next."""
    xp = namespace(state.x)
    first = state.evaluations == state.before
    raw, linearise = evaluate(state.trial, task.data)
    cost, total, weighted, slope = _costs(loss, raw, task)
    gain = (state.cost - cost) / xp.maximum(state.predicted, xp.finfo(cost.dtype).tiny)
    wanted = xp.where(state.damping > 0, ACCEPTED, TRUSTED)
    taken = xp.isfinite(cost) & (first | ((gain > wanted) & (cost < state.cost)))

    def fresh():
        factor = xp.where(task.weights > 0, task.weights * slope, 0)
        return linearise() if xp is np and (factor == 1).all() else factor[:, None] * linearise()

    jacobian = lax.cond(taken, fresh, lambda: state.jacobian) if xp is jnp else (fresh() if taken else state.jacobian)
    finite = xp.isfinite(cost) & (~taken | xp.isfinite(xp.sum(jacobian)))
    taken = taken & finite
    jacobian = xp.where(taken, jacobian, state.jacobian) if xp is jnp else (jacobian if taken else state.jacobian)
    counted = taken & ~first
    state = state._replace(
        x=xp.where(taken, state.trial, state.x),
        cost=xp.where(taken, cost, state.cost),
        total=xp.where(taken, total, state.total),
        residual=xp.where(taken, weighted, state.residual),
        bent=xp.where(taken, weighted * slope, state.bent),
        jacobian=jacobian,
        scale=xp.where(taken, xp.maximum(state.scale, column_norms(jacobian)), state.scale),
        nonfinite=state.nonfinite + ~finite,
        evaluations=state.evaluations + 1,
        iterations=state.iterations + counted,
        history=xp.where(counted & (xp.arange(len(state.history)) == state.iterations), total, state.history),
        **_damping(state, gain, taken, first),
    )
    return _next_trial(state, task, taken, first & ~finite, weighted * slope)


def _costs(loss: Loss, raw: Any, task: Task) -> tuple[Any, Any, Any, Any]:
    """Sum of losses, sum of squares of everything, the weighted residual, and what a robust loss makes of it."""
    xp = namespace(raw)
    weighted = xp.where(task.weights > 0, raw * task.weights, 0)
    losses, slope = loss(weighted / task.spread)
    everything = xp.where(task.all_weights > 0, raw * task.all_weights, 0)
    return xp.sum(losses) * task.spread**2, xp.sum(everything**2), weighted, slope


def column_norms(jacobian: Any) -> Any:
    """The norms of the columns, without over- or underflow of the squares."""
    xp = namespace(jacobian)
    if xp is np:
        squares = np.einsum("ij,ij->j", jacobian, jacobian)
        if ((squares > 1e-200) & (squares < 1e200)).all():
            return np.sqrt(squares)
    largest = xp.max(xp.abs(jacobian), axis=0, initial=0)
    safe = xp.where(largest > 0, largest, 1)
    return largest * xp.sqrt(xp.sum((jacobian / safe) ** 2, axis=0))


def _damping(state: State, gain: Any, taken: Any, first: Any) -> dict[str, Any]:
    """Less damping where the linear model held, more where it did not; none for the first step."""
    xp, damping, growth = namespace(state.x), state.damping, state.growth
    smaller = damping * xp.where(gain > 0.75, 0.1, xp.where(gain > TRUSTED, 0.5, 2.0))
    smaller = xp.where(smaller < 1e-7, xp.where(gain > TRUSTED, 0.0, 1e-3), smaller)
    larger = xp.maximum(damping * growth, 1e-3)
    return {
        "damping": xp.where(first, 0.0, xp.where(taken, smaller, larger)).astype(damping.dtype),
        "growth": xp.where(taken, 2.0, growth * 2).astype(growth.dtype),
    }


def _next_trial(state: State, task: Task, taken: Any, lost: Any, at_trial: Any) -> State:
    """The damped step to the next trial, and whether the search is at its end."""
    xp = namespace(state.x)
    scaled = state.jacobian / xp.where(state.scale > 0, state.scale, 1)
    q, triangle = projected(scaled, xp.stack([state.bent, at_trial], axis=1))
    model = _Model(q[:, 0], triangle, state.scale, state.x, task.lower, task.upper)
    step, predicted = _bounded_step(model, state.damping)
    if xp is jnp or not taken:
        step = step + xp.where(taken, 0, _around_the_bend(model, state.trial, q[:, 1], step, state.damping))
    newton = _newton_decrease(model)
    freedom = xp.maximum(xp.sum(task.weights > 0) - len(state.x), 1)
    left = xp.maximum(state.cost - newton, xp.finfo(state.x.dtype).tiny)
    offset = xp.sqrt(newton / len(state.x) / (left / freedom))
    trial = xp.clip(state.x + step, task.lower, task.upper)

    eps = task.precision
    size = xp.linalg.norm(state.scale * state.x)
    no_step = xp.linalg.norm(state.scale * (trial - state.x)) <= 4 * eps * size
    # what is left to gain is below the rounding of the residuals r, or of their squares, 2 |r| times that
    flat = (newton <= (1e3 * eps * size) ** 2) | (newton <= 4 * eps * (state.cost + size * xp.sqrt(state.cost)))
    ended = xp.where(no_step | (state.growth > 1e12), STALLED, RUNNING)
    ended = xp.where((no_step | ~taken) & flat, ROUNDED, ended)
    ended = xp.where((offset <= task.tolerance) | (state.cost <= task.enough), CONVERGED, ended)
    status = xp.where(lost, NOT_FINITE, ended).astype(xp.int32)
    return state._replace(trial=trial, predicted=predicted, status=status, offset=xp.where(lost, xp.inf, offset))


def _around_the_bend(model: _Model, tried: Any, q_tried: Any, step: Any, damping: Any) -> Any:
    """What the residual at a trial that was not taken says of the curve that the next step should follow.

        a = -J^+ (r(x + d) - r - J d) |s|^2 / |d|^2,   nothing where that is more than 3/4 of the step

    Source: M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
      minimization, 2012 (geodesic acceleration), with the second derivative from the trial, which is there already.
    """
    xp = namespace(model.x)
    scale = xp.where(model.scale > 0, model.scale, 1)
    d, s = (tried - model.x) * scale, step * scale
    bent = q_tried - model.q - model.triangle @ d
    ratio = xp.sum(s**2) / xp.maximum(xp.sum(d**2), xp.finfo(d.dtype).tiny)
    a = damped_solution(model.triangle, xp.where(xp.all(xp.isfinite(bent)), bent, 0) * ratio, damping)
    small = xp.isfinite(xp.sum(a)) & (xp.sum(a**2) <= 0.5625 * xp.sum(s**2))
    return xp.where(small, a, 0) / scale


class _Model(NamedTuple):
    """The residual as a linear function of a step: |q + R D s|^2 and what no step changes."""

    q: Array
    triangle: Array  # R of J D^-1
    scale: Array
    x: Array
    lower: Array
    upper: Array

    def slope(self, s: Array) -> Array:
        """Half the gradient of the model by D s."""
        return self.triangle.T @ (self.q + self.triangle @ s)


def _held(model: _Model, s: Any) -> Any:
    """Which parameters stand at a bound that the model would have them cross."""
    slope = model.slope(s)
    return ((model.x <= model.lower) & (slope > 0)) | ((model.x >= model.upper) & (slope < 0))


def _bounded_step(model: _Model, damping: Any) -> tuple[Any, Any]:
    """The damped step in x, and the decrease that the model predicts for it; who would cross a bound stops there."""
    xp = namespace(model.x)
    scale = xp.where(model.scale > 0, model.scale, 1)
    low, high = (model.lower - model.x) * scale, (model.upper - model.x) * scale

    def solve(carry):
        held, s, _, turns = carry
        free = damped_solution(xp.where(held, 0, model.triangle), model.q + model.triangle @ s, damping)
        whole = xp.where(held, s, free)
        outside = ~held & ((whole < low) | (whole > high))
        stopped = xp.where(outside, xp.clip(whole, low, high), s)
        more = xp.any(outside)
        return held | outside, xp.where(more, stopped, whole), more, turns + 1

    none = xp.zeros_like(model.x)
    carry = (_held(model, none), none, xp.asarray(True), xp.zeros((), xp.int32))
    _, s, _, _ = _while(lambda c: c[2] & (c[3] <= len(model.x)), solve, carry, xp)
    s = xp.clip(s, low, high)
    predicted = xp.sum(model.q**2) - xp.sum((model.q + model.triangle @ s) ** 2)
    return s / scale, predicted


def _decomposed(triangle: Any) -> tuple[Any, Any, Any, Any]:
    """Singular vectors and values of R, and which are above rounding."""
    xp = namespace(triangle)
    u, values, vt = xp.linalg.svd(triangle, full_matrices=False)
    cut = xp.finfo(values.dtype).eps * max(triangle.shape) * 10 * xp.max(values, initial=0)
    return u, values, vt, values > cut


def damped_solution(triangle: Any, q: Any, damping: Any) -> Any:
    """s that minimises |R s + q|^2 + damping |s|^2; of several the shortest, so what has no effect does not move."""
    xp = namespace(triangle)
    u, values, vt, seen = _decomposed(triangle)
    inverse = xp.where(seen, values, 0) / xp.where(seen, values**2 + damping, 1)
    return -vt.T @ (inverse * (u.T @ q))


def _newton_decrease(model: _Model) -> Any:
    """How far below the cost the minimum of the model lies, over what is not held at a bound."""
    xp = namespace(model.x)
    held = _held(model, xp.zeros_like(model.x))
    u, _, _, seen = _decomposed(xp.where(held, 0, model.triangle))
    return xp.sum(xp.where(seen, u.T @ model.q, 0) ** 2)
