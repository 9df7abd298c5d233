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
from jeuler.fitting.nearby import from_nearby
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import FlatResidual, Problem, marks, variance_of_noise
from jeuler.fitting.profiles import AGAIN, Again, Ended
from jeuler.fitting.report import INVERSE, ending, report
from jeuler.fitting.report import NOT_FINITE as WITHOUT_A_START
from jeuler.fitting.result import Fit
from jeuler.fitting.starts import best_of, starts_of

PROBES = 8  # random directions that estimate the norms of the columns
MOST_PRODUCTS = 300  # iterations of conjugate gradients in one step
ACCURACY = 0.05  # of the decrease that a step makes, relative,
ACCURATE = 1e-4  # and where the linear model was right about the step before
RIGHT = 0.1  # of the predicted decrease: it was right if it kept to that
NEAR = 0.05  # standard errors, root mean square over the unknowns: how far from the minimum a search may end
FEWEST = 40  # iterations of conjugate gradients after which their estimate of what is left is believed
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
    right: np.ndarray  # whether the linear model was right about the last step


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
    def step(x: Array, task: Task, damping: Array, accuracy: Array, share: Array) -> tuple[Array, Array, Array]:
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

        size = jnp.sum(rho(r / task.spread)[0]) * task.spread**2
        s, left, more = conjugate_gradients(normal, -unit * gradient, accuracy, lambda total: share * (size - total))
        decrease = jnp.sum(s * (left - unit * gradient)) + damping * jnp.sum(s**2)
        return unit * s, decrease, more

    return Products(cost, step)


def conjugate_gradients(product: Any, b: Array, accuracy: Any, enough: Any) -> tuple[Array, Array, Array]:
    """s with A s = b, nearly, b - A s, and an estimate of how far s^T A s - 2 b^T s would still fall.

        n (Q_n - Q_(n-1)) < accuracy Q_n,   or less than is enough, after a few iterations

    Args:
      product: s -> A s, symmetric and positive semidefinite.
      b: (n,).
      accuracy: of the decrease, relative.
      enough: decrease so far -> what may be left of it.
    Source: S. G. Nash, A. Sofer, Assessing a search direction within a truncated-Newton method, Operations Research
      Letters 9, 1990 (when to stop).
    """

    def goes_on(carry: Any) -> Any:
        _, _, _, square, gained, total, n = carry
        little = (n * gained < accuracy * total) | ((n >= FEWEST) & (n * gained < enough(total)))
        return (n < MOST_PRODUCTS) & (square > 0) & ((n == 0) | ~little)

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
    begun = jnp.zeros_like(b), b, b, jnp.sum(b**2), zero, zero, 0
    s, left, _, square, gained, _, n = lax.while_loop(goes_on, turn, begun)
    return s, left, jnp.where(square > 0, n * gained, 0)


def run_matrix_free(
    problem: Problem, options: Options, evaluate: Evaluate, known: Known
) -> tuple[Fit, State | None, bool]:
    """The fit of a problem whose Jacobian the search does not form, where it ended, and whether the user stopped it.

    The Jacobian is formed once for the errors, where it is not too large: at the end, or at the start where that is
    near enough for it to lead to the minimum; else the state is None.
    """
    task = problem.task(options.tolerance)
    spread = options.loss_scale if options.loss_scale is not None else TUNING * (known.noise or 1.0)
    task = task._replace(spread=np.asarray(spread if options.loss != "linear" else 1.0))
    own, x, m = products(problem.residual, options.loss), np.asarray(problem.x, float), problem.form.size
    record = Record.of(options.resume, lambda: marks(problem, options, task))
    with progress_bar(options.progress, options.max_iterations) as bar:
        watch, starts, stages = Watch(bar, record), None, problem.stages
        if options.starts is not None:
            x, starts = best_of(problem, *_ends(own, problem, options, task, watch))
            stages = ()
        kept = None if record is None else record.load(beginning(x, m))
        first, point, history = (0, beginning(x, m), []) if kept is None else kept
        formed = None
        if known.near and kept is None and options.loss == "linear" and not stages and _is_formed(problem):
            formed = from_nearby(evaluate, x, task, options.max_iterations, history, watch)
        if formed is None:
            for stage, mask in enumerate((*stages, task.all_weights)):
                if stage < first or (watch.interrupted and stage < len(stages)):
                    continue
                if stage > first or kept is None:
                    point = beginning(point.x, m, point.nonfinite)
                point = descend(own, point, task._replace(weights=mask), options.max_iterations, stage, history, watch)
    if formed is None and not np.isfinite(point.total):
        raise ValueError(WITHOUT_A_START)
    words, state = ending(formed or point, watch), formed or _state_of(point)
    bend = float(task.spread)
    formed = formed or _with_jacobian(problem, evaluate, state, task, options.loss)
    if formed is not None:
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


def _state_of(point: Point) -> State:
    """A point without a Jacobian as a state, for the report."""
    names = ("total", "residual", "nonfinite", "status")
    return start(point.x, 0, 1)._replace(**{name: getattr(point, name) for name in names})


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
    if not _is_formed(problem):
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


def _is_formed(problem: Problem) -> bool:
    """Whether the Jacobian is not too large for the errors."""
    n, m = problem.layout.size, problem.form.size
    return n <= MOST_ERRORS and 8 * m * n <= MOST_BYTES


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
        np.asarray(False),
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
    """One damped step, taken or not; the last is after which ``least`` standard errors are left."""
    x, damping = point.x, point.damping
    freedom = max(int(np.sum(task.weights > 0)) - len(x), 1)
    allowed = least**2 * len(x) / freedom  # of the cost
    accuracy = np.asarray(ACCURATE if point.right else ACCURACY)
    found = products.step(x, task, damping, accuracy, np.asarray(allowed))
    step, decrease, more = (np.asarray(a, float) for a in found)
    trial = np.clip(x + step, task.lower, task.upper)
    cost, total, r = (np.asarray(a, float) for a in products.cost(trial, task))
    predicted = max(float(point.cost - decrease), 1e-300)
    gain = float(point.cost - cost) / max(float(decrease), 1e-300)
    solved = more <= allowed * predicted and abs(cost - predicted) <= allowed * predicted
    near = decrease <= allowed * predicted or decrease <= 1e2 * task.precision * point.cost
    nonfinite = point.nonfinite + (not np.isfinite(cost))
    if np.isfinite(cost) and cost < point.cost and gain > (1e-3 if damping else 0.1):
        damped, damping = damping > 0, damping * (0.1 if gain > 0.75 else 0.5)
        return Point(
            trial,
            cost,
            total,
            r,
            np.asarray(damping if damping > 1e-6 else 0.0),
            np.asarray(2.0),
            point.iterations + 1,
            nonfinite,
            np.asarray(CONVERGED if not damped and (near or solved) and gain > 0.5 else RUNNING),
            np.asarray(not damped and abs(gain - 1) <= RIGHT),
        )
    flat = damping == 0 and near and abs(gain) <= 1  # worse by less than was to be gained: rounding
    status = CONVERGED if flat else STALLED if point.growth > 1e12 else RUNNING
    damping = np.asarray(max(damping * point.growth, 1e-3))
    point = point._replace(damping=damping, growth=point.growth * 2, nonfinite=nonfinite, right=np.asarray(False))
    return point._replace(status=np.asarray(status))
