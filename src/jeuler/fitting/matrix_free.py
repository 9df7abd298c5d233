"""Levenberg-Marquardt for many unknowns: products with the Jacobian and its transpose, and no Jacobian.

The linear problem of each step is solved by conjugate gradients. They are written out here: `lineax.CG` and
`jax.scipy.sparse.linalg.cg` compile the product two or three times, and a product, which is a run forwards and one
backwards, takes longer to compile than all its runs take; nor do they give the decrease that the step is to make.
optimistix's Levenberg-Marquardt has no bounds, nor a scale for each unknown, without which it hardly converges here.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler.fitting.asked import ASKED, Asked, quick_to_compile
from jeuler.fitting.beside import attach, attached
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.kept import SEARCH, STARTS, Record
from jeuler.fitting.least_squares import (
    CONVERGED,
    NOT_FINITE,
    RUNNING,
    STALLED,
    State,
    Task,
    column_norms,
    start,
)
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.many import MOST_BYTES, MOST_ERRORS, weighted_jacobian
from jeuler.fitting.minimise import TUNING, Watch, progress_bar
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import FlatResidual, Problem, marks, variance_of_noise
from jeuler.fitting.profiles import AGAIN, Again, Ended
from jeuler.fitting.report import INVERSE, ending, report
from jeuler.fitting.report import NOT_FINITE as WITHOUT_A_START
from jeuler.fitting.result import Fit
from jeuler.fitting.starts import best_of, starts_of

PROBES = 8  # random directions that estimate the norms of the columns
MOST_PRODUCTS = 300  # iterations of conjugate gradients in one step
ACCURACY = 0.05  # of the decrease that a step makes, relative
NEAR = 0.05  # standard errors, root mean square over the unknowns: such a step is the last
NEARER = 0.02  # of the variance of the noise: what a search for a profile may still have to gain before its last step
MOST_STEPS = 100  # of such a search


class Point(NamedTuple):
    """Where a search is."""

    x: np.ndarray
    cost: np.ndarray  # sum of the losses of what counts; inf before it was computed
    total: np.ndarray  # sum of squares over everything
    residual: np.ndarray  # weighted
    damping: np.ndarray
    growth: np.ndarray
    iterations: np.ndarray
    nonfinite: np.ndarray
    status: np.ndarray


class Products(NamedTuple):
    """The compiled programs of a residual."""

    cost: Any
    step: Any


@functools.lru_cache(maxsize=8)
def products(residual: FlatResidual, loss: str) -> Products:
    """Cost and damped step of a residual; kept, so that a fit of the same shape uses them again."""
    rho, residual = LOSSES[loss], quick_to_compile(residual)

    def weighted(x: Array, task: Task) -> Array:
        return jnp.where(task.weights > 0, residual(x, task.data) * task.weights, 0)

    @jax.jit
    def cost(x: Array, task: Task) -> tuple[Array, Array, Array]:
        raw = residual(x, task.data)
        r, everything = (jnp.where(w > 0, raw * w, 0) for w in (task.weights, task.all_weights))
        return jnp.sum(rho(r / task.spread)[0]) * task.spread**2, jnp.sum(everything**2), r

    @jax.jit
    def step(x: Array, task: Task, damping: Array) -> tuple[Array, Array]:
        r, forwards = jax.linearize(lambda x: weighted(x, task), x)
        backwards = jax.linear_transpose(forwards, x)
        slope = rho(r / task.spread)[1]
        signs = jax.random.rademacher(jax.random.key(0), (PROBES, len(r)), x.dtype)
        rows = lax.map(lambda row: backwards(slope * row)[0], jnp.concatenate([(slope * r)[None], signs]))
        gradient, norms = rows[0], jnp.sqrt(jnp.mean(rows[1:] ** 2, axis=0))
        largest = jnp.max(norms)
        scale = jnp.where(norms > 1e-6 * largest, norms, jnp.maximum(largest, jnp.finfo(x.dtype).tiny))
        held = ((x <= task.lower) & (gradient > 0)) | ((x >= task.upper) & (gradient < 0))
        unit = jnp.where(held, 0, 1 / scale)

        def normal(s: Array) -> Array:
            return unit * backwards(slope**2 * forwards(unit * s))[0] + damping * s

        s, left = conjugate_gradients(normal, -unit * gradient)
        decrease = jnp.sum(s * (left - unit * gradient)) + damping * jnp.sum(s**2)
        return unit * s, decrease

    return Products(cost, step)


def conjugate_gradients(product: Any, b: Array) -> tuple[Array, Array]:
    """s with A s = b, nearly, and b - A s: stopped when going on would hardly decrease s^T A s / 2 - b^T s further.

        n (Q_n - Q_(n-1)) < accuracy Q_n

    Args:
      product: s -> A s, symmetric and positive semidefinite.
      b: (n,).
    Source: S. G. Nash, A. Sofer, Assessing a search direction within a truncated-Newton method, Operations Research
      Letters 9, 1990 (when to stop).
    """

    def goes_on(carry: Any) -> Any:
        _, _, _, square, gained, total, n = carry
        return (n < MOST_PRODUCTS) & (square > 0) & (n * gained >= ACCURACY * total)

    def turn(carry: Any) -> Any:
        s, left, direction, square, _, total, n = carry
        image = product(direction)
        bend = jnp.sum(direction * image)
        length = jnp.where(bend > 0, square / jnp.where(bend > 0, bend, 1), 0)
        s, left = s + length * direction, left - length * image
        new = jnp.where(bend > 0, jnp.sum(left**2), 0)
        gained = length * square
        return s, left, left + new / square * direction, new, gained, total + gained, n + 1

    zero = jnp.zeros((), b.dtype)
    s, left, *_ = lax.while_loop(goes_on, turn, (jnp.zeros_like(b), b, b, jnp.sum(b**2), zero, zero, 0))
    return s, left


def run_matrix_free(
    problem: Problem, options: Options, evaluate: Evaluate, known: Known
) -> tuple[Fit, State | None, bool]:
    """The fit of a problem whose Jacobian the search does not form, where it ended, and whether the user stopped it.

    The Jacobian is formed once at the end, for the errors, where it is not too large; else the state is None.
    """
    task = problem.task(options.tolerance)
    spread = options.loss_scale if options.loss_scale is not None else TUNING * (known.noise or 1.0)
    task = task._replace(spread=np.asarray(spread if options.loss != "linear" else 1.0))
    own, x = products(problem.residual, options.loss), np.asarray(problem.x, float)
    record = Record.of(options.resume, *marks(problem, options, task))
    with progress_bar(options.progress, options.max_iterations) as bar:
        watch, starts, stages = Watch(bar, record), None, problem.stages
        if options.starts is not None:
            x, starts = best_of(problem, *_ends(own, problem, options, task, watch))
            stages = ()
        kept = None if record is None else record.load(beginning(x, problem.form.size))
        first, point, history = (0, beginning(x, problem.form.size), []) if kept is None else kept
        for stage, mask in enumerate((*stages, task.all_weights)):
            if stage < first or (watch.interrupted and stage < len(stages)):
                continue
            if stage > first or kept is None:
                point = beginning(point.x, problem.form.size, point.nonfinite)
            point = descend(own, point, task._replace(weights=mask), options.max_iterations, stage, history, watch)
    if not np.isfinite(point.total):
        raise ValueError(WITHOUT_A_START)
    state, words = start(point.x, 0, 1), ending(point, watch)
    state = state._replace(**{name: getattr(point, name) for name in ("total", "residual", "nonfinite", "status")})
    bend = float(task.spread)
    if (formed := _with_jacobian(problem, evaluate, state, task, options.loss)) is not None:
        fit = report(problem, formed, history, bend, options.loss, words, known, starts)
        attach(fit, AGAIN, _again(own, problem, task, fit, formed, None))
        return fit, formed, watch.interrupted
    more = (
        *known.more,
        f"standard errors are not computed for {len(x)} unknowns: .standard_error(name) gives those that you ask for",
    )
    fit = report(problem, state, history, bend, options.loss, words, Known(known.variance, known.noise, more), starts)
    if not watch.interrupted:
        asked = Asked(problem, options.loss, state, task)
        attach(fit, ASKED, asked)
        attach(fit, AGAIN, _again(own, problem, task, fit, state, asked))
    return fit, None, watch.interrupted


def _ends(own: Products, problem: Problem, options: Options, task: Task, watch: Watch) -> tuple[np.ndarray, np.ndarray]:
    """Where the searches from many starts end, (start, n), and the cost of each, as far as the user lets them."""
    record, x, m = watch.record, np.asarray(problem.x, float), problem.form.size
    if record is not None and record.all_ends is not None:
        return record.all_ends
    xs = starts_of(problem.layout, options, x, task, lambda: np.where(x != 0, np.abs(x), 1.0))
    kept = None if record is None else record.load(beginning(x, m), STARTS)
    ends = [] if record is None or record.ends is None else list(zip(*record.ends, strict=True))
    watch.part = STARTS
    for k in range(len(ends), len(xs)):
        point = kept[1] if kept is not None and kept[0] == k else beginning(xs[k], m)
        point = descend(own, point, task, options.max_iterations, k, [], watch)
        ends.append((point.x, float(point.total)))
        if watch.interrupted:
            break
        if record is not None:
            record.ends = np.stack([x for x, _ in ends]), np.array([total for _, total in ends])
    watch.part = SEARCH
    return np.stack([x for x, _ in ends]), np.array([total for _, total in ends])


def _again(own: Products, problem: Problem, task: Task, fit: Fit, state: State, asked: Asked | None) -> Again:
    """What a profile needs of this fit: errors and directions from its matrices, or one by one."""
    layout, m, n = problem.layout, problem.form.size, len(state.x)
    near, inverse, both = np.sqrt(NEARER / n), attached(fit, INVERSE), np.zeros((2, n))
    if asked is None:
        both = np.array([layout.vector(error) for error in (fit.stderr, fit.stderr_white)], float)

    def search(task: Task, x: np.ndarray) -> Ended:
        with progress_bar(False, 1) as bar:
            watch = Watch(bar)
            point = descend(own, beginning(x, m), task, MOST_STEPS, 0, [], watch, near)
        if watch.interrupted:
            raise KeyboardInterrupt
        return Ended(point.x, float(point.cost), bool(point.status == CONVERGED))

    def errors(k: int) -> tuple[float, float]:
        return asked.errors(np.eye(1, n, k)[0]) if asked is not None else (float(both[0, k]), float(both[1, k]))

    def follows(k: int) -> np.ndarray:
        return asked.follows(k) if asked is not None else inverse[:, k] / inverse[k, k]

    return Again(layout, task, state.x, search, errors, follows, variance_of_noise(problem, task, state))


def _with_jacobian(problem: Problem, evaluate: Evaluate, state: State, task: Task, loss: str) -> State | None:
    """The state with its Jacobian; None where that is too large, not finite, or the user stops it."""
    n, m = len(state.x), problem.form.size
    if n > MOST_ERRORS or 8 * m * n > MOST_BYTES:
        return None
    try:
        jacobian = weighted_jacobian(evaluate, state.x, task.data, np.asarray(task.all_weights, float))
    except KeyboardInterrupt:
        return None
    if not np.isfinite(np.sum(jacobian)):
        return None
    _, slope = LOSSES[loss](state.residual / task.spread)
    if loss != "linear":
        jacobian *= slope[:, None]
    return state._replace(jacobian=jacobian, scale=column_norms(jacobian))


def beginning(x: np.ndarray, m: int, nonfinite: Any = 0) -> Point:
    """The point before anything has been evaluated."""
    unknown, count = np.asarray(np.inf), np.asarray(0)
    return Point(
        x,
        unknown,
        unknown,
        np.zeros(m),
        np.asarray(0.0),
        np.asarray(2.0),
        count,
        np.asarray(nonfinite),
        np.asarray(RUNNING),
    )


def descend(
    products: Products,
    point: Point,
    task: Task,
    most: int,
    stage: int,
    history: list[float],
    watch: Watch,
    near: float = NEAR,
) -> Point:
    """Damped steps to the minimum, or to what can be had of it."""
    if not np.isfinite(point.cost):
        cost, total, r = (np.asarray(a, float) for a in products.cost(point.x, task))
        point = point._replace(cost=cost, total=total, residual=r)
        if not np.isfinite(cost):
            return point._replace(nonfinite=point.nonfinite + 1, status=np.asarray(NOT_FINITE))
    return watch.follow(lambda point: _iterate(products, point, task, near), point, most, stage, history)


def _iterate(products: Products, point: Point, task: Task, least: float) -> Point:
    """One damped step, taken or not; the last is where ``least`` standard errors are left."""
    x, damping = point.x, point.damping
    step, decrease = (np.asarray(a, float) for a in products.step(x, task, damping))
    freedom = max(int(np.sum(task.weights > 0)) - len(x), 1)
    offset = np.sqrt(max(float(decrease), 0.0) / len(x) / (max(float(point.cost - decrease), 1e-300) / freedom))
    near = damping == 0 and (offset <= least or decrease <= 1e2 * task.precision * point.cost)
    trial = np.clip(x + step, task.lower, task.upper)
    cost, total, r = (np.asarray(a, float) for a in products.cost(trial, task))
    gain = float(point.cost - cost) / max(float(decrease), 1e-300)
    nonfinite = point.nonfinite + (not np.isfinite(cost))
    if np.isfinite(cost) and cost < point.cost and gain > (1e-3 if damping else 0.1):
        damping = damping * (0.1 if gain > 0.75 else 0.5)
        return Point(
            trial,
            cost,
            total,
            r,
            np.asarray(damping if damping > 1e-6 else 0.0),
            np.asarray(2.0),
            point.iterations + 1,
            nonfinite,
            np.asarray(CONVERGED if near and gain > 0.5 else RUNNING),
        )
    flat = near and abs(gain) <= 1  # worse by less than was to be gained: rounding
    status = CONVERGED if flat else STALLED if point.growth > 1e12 else RUNNING
    damping = np.asarray(max(damping * point.growth, 1e-3))
    return point._replace(damping=damping, growth=point.growth * 2, nonfinite=nonfinite, status=np.asarray(status))
