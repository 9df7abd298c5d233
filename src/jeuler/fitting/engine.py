"""From a checked problem to a `Fit`: the search, what it is worth, and the words for it."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.partition import arrays_only
from jeuler.fitting import least_squares
from jeuler.fitting.blind import describe_blind
from jeuler.fitting.kept import Record
from jeuler.fitting.least_squares import State, Task
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minimise import TUNING, Watch, descend, many_starts, search
from jeuler.fitting.problem import FlatResidual, programs, residual_layout, residual_weights, series_of
from jeuler.fitting.profiles import Again, keep
from jeuler.fitting.result import Fit, Verdict
from jeuler.fitting.uncertainty import Uncertainty, directions, uncertainty
from jeuler.fitting.unknowns import Layout, checked_bounds, readable

PyTree = Any
JACOBIAN_BYTES = 2**30  # a Jacobian larger than this is not formed,
MOST_COLUMNS = 500  # nor one of more columns: a run of the model for each takes longer than conjugate gradients


@dataclasses.dataclass(frozen=True)
class Known:
    """What a caller knows of the data: for the share explained and the residual against the noise.

    Attributes:
      variance: sum of squares of the data about their mean, weighted; None where it is not known.
      noise: standard deviation of the noise, weighted; None where it is not known.
      more: further sentences for the message.
    """

    variance: float | None = None
    noise: float | None = None
    more: tuple[str, ...] = ()


class Outcome(NamedTuple):
    """A fit, and where its search ended; None where that was traced."""

    fit: Fit
    state: State | None


@dataclasses.dataclass(frozen=True)
class Options:
    """How a fit is done."""

    loss: str = "linear"
    loss_scale: float | None = None
    starts: Any = None
    optimizer: Any = None
    max_iterations: int = 200
    tolerance: float = 1e-4
    resume: Any = None
    progress: bool | None = None

    def check(self) -> None:
        """One ValueError that says which option is wrong."""
        checks.positive("tolerance", self.tolerance)
        if self.loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(map(repr, LOSSES))}, got {self.loss!r}")
        if self.loss_scale is not None:
            checks.positive("loss_scale", self.loss_scale)
        if self.optimizer is not None and not hasattr(self.optimizer, "update"):
            raise ValueError(
                f"optimizer must be an optax optimiser, such as optax.adam(0.05), or None, got {self.optimizer!r}"
            )
        if self.optimizer is not None:
            for name in ("starts", "resume"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} is for Levenberg-Marquardt; leave it out, or leave optimizer out")
            if self.loss != "linear":
                raise ValueError('loss must be "linear" with an optax optimiser; put the loss into the residual')


@dataclasses.dataclass(frozen=True)
class Problem:
    """A residual with its data, weights, bounds and start, checked."""

    residual: FlatResidual
    form: Layout  # of what the residual returns
    data: Any
    x: Any
    lower: Any
    upper: Any
    weights: Any
    absolute: bool
    stages: tuple[Any, ...]
    closes_over_traced: bool = False

    @classmethod
    def of(
        cls,
        residual: Callable[..., Any],
        params: PyTree,
        *,
        data: PyTree = None,
        bounds: PyTree = None,
        positive: PyTree = False,
        sigma: PyTree = None,
        weights: PyTree = None,
        stages: Iterable[PyTree] = (),
    ) -> Problem:
        """From what a person passes, or one ValueError that says what is wrong with it."""
        layout = Layout.of(params)
        x = layout.vector(params)
        lower, upper = checked_bounds(layout, x, bounds, positive)
        with_data = data is not None
        if with_data:
            residual, data = arrays_only(residual, data)
        form, closes_over_traced = residual_layout(residual, params, data, with_data)
        if not form.size or not layout.size:
            raise ValueError(
                f"residual and params must not be empty, got {form.size} residuals and {layout.size} parameters"
            )
        weight = residual_weights(form, sigma, weights)
        masks = tuple(_stage(form, stage, weight) for stage in stages)
        flat = FlatResidual(residual, layout, with_data)
        return cls(flat, form, data, x, lower, upper, weight, sigma is not None, masks, closes_over_traced)

    @property
    def layout(self) -> Layout:
        return self.residual.layout

    @property
    def traced(self) -> bool:
        """Whether any part of it is being traced."""
        parts = (self.data, self.x, self.lower, self.upper, self.weights, self.stages)
        return self.closes_over_traced or any(map(checks.is_traced, jax.tree.leaves(parts)))

    @property
    def precision(self) -> float:
        """The unit roundoff of the residual's arithmetic."""
        used = [d for d in (*self.form.dtypes, *self.layout.dtypes) if d is not None]
        return max(float(jnp.finfo(dtype).eps) for dtype in used)

    def task(self, tolerance: float) -> Task:
        """What the search is given, of NumPy in float64 unless something is traced."""
        if self.traced:
            dtype = self.layout.dtype
            own: list[Any] = [jnp.asarray(a, dtype) for a in (self.weights, self.weights, self.lower, self.upper)]
            rest: list[Any] = [jnp.asarray(a, dtype) for a in (1.0, tolerance, self.precision, 0.0)]
        else:
            own = [np.asarray(a, float) for a in (self.weights, self.weights, self.lower, self.upper)]
            rest = [np.asarray(a, float) for a in (1.0, tolerance, self.precision, 0.0)]
        return Task(self.data, *own, *rest)


def _stage(form: Layout, stage: PyTree, weight: Any) -> Any:
    values = form.spread("each of stages", stage, 1.0) if isinstance(stage, (dict, list, tuple)) else stage
    if np.size(values) != form.size:
        raise ValueError(f"each of stages must have one weight a residual, {form.size}, got {np.size(values)}")
    xp: Any = jnp if any(map(checks.is_traced, (values, weight))) else np
    return weight * xp.sqrt(xp.maximum(xp.ravel(xp.asarray(values)), 0))


def run(problem: Problem, options: Options, *, scale: PyTree = None, known: Known | None = None) -> Outcome:
    """Search, and report."""
    if problem.traced:
        from jeuler.fitting.traced import run_traced

        return Outcome(run_traced(problem, options), None)
    known = known or Known()
    evaluate, task = programs(problem.residual), problem.task(options.tolerance)
    x = np.asarray(problem.x, float)
    m, n = problem.form.size, len(x)
    small = m * n * 8 <= JACOBIAN_BYTES and n <= MOST_COLUMNS
    if not small and options.optimizer is None:
        from jeuler.fitting.matrix_free import run_matrix_free

        return run_matrix_free(problem, options, known)
    record = None
    if options.resume is not None:
        record = Record.of(options.resume, task, problem.stages, x, repr(problem.layout.shapes), options.loss)
    starts = None
    with progress_bar(options.progress, options.max_iterations * (len(problem.stages) + 1)) as bar:
        watch = Watch(bar, record)
        if options.optimizer is not None:
            return _by_optax(problem, options, evaluate, task, x, scale, watch, known)
        if options.starts is not None:
            x, starts = _best_start(problem, options, evaluate, task, x, watch)
        spread = options.loss_scale if options.loss_scale is not None else (TUNING if problem.absolute else None)
        found = search(
            evaluate,
            LOSSES[options.loss],
            x,
            task,
            problem.stages if starts is None else (),
            max_iterations=options.max_iterations,
            watch=watch,
            spread=spread,
            noise=known.noise,
        )
    state = found.state
    if not np.isfinite(state.cost):
        raise ValueError(NOT_FINITE)
    words = ending(state, watch)
    fit = report(problem, state, found.history, found.spread, options.loss, words, known, starts)
    if fit.stderr is not None:
        task = task._replace(spread=np.asarray(found.spread))
        keep(fit, _again(problem, evaluate, options.loss, task, state, fit))
    return Outcome(fit, state)


NOT_FINITE = (
    "the residual is not finite at the start of the fit, nor at any point that was tried; "
    "start closer, or use a smaller dt or a stabler step"
)


@contextlib.contextmanager
def progress_bar(progress: bool | None, total: int):
    from tqdm import tqdm

    with tqdm(total=total, desc="fit", disable=None if progress is None else not progress, leave=False) as bar:
        yield bar


def ending(state: State, watch: Watch | None = None) -> str:
    """How a search ended, in words."""
    if watch is not None and watch.interrupted:
        return "interrupted: the best so far"
    if state.status in (least_squares.CONVERGED, least_squares.ROUNDED):
        return "converged"
    if state.status == least_squares.STALLED:
        return (
            "stopped before it converged: no step makes the residual smaller, though its gradient is not zero; "
            "it jumps or is not finite near here, so use a smaller dt or start elsewhere"
        )
    return "stopped before it converged: allow more iterations or start closer"


def _again(problem: Problem, evaluate: Any, loss: str, task: Task, state: State, fit: Fit) -> Again:
    """What a profile needs of this fit."""
    error, white = (np.asarray(problem.layout.vector(e), float) for e in (fit.stderr, fit.stderr_white))
    freedom = max(int(np.sum(task.all_weights > 0)) - len(state.x), 1)
    variance = 1.0 if problem.absolute else float(np.sum(np.asarray(state.residual) ** 2)) / freedom
    return Again(problem.layout, evaluate, LOSSES[loss], task, state, error, white, max(variance, 1e-300))


def _by_optax(problem, options, evaluate, task, x, scale, watch, known) -> Outcome:
    """A descent by an optax optimiser, and its report."""
    unit = np.asarray(problem.layout.spread("scale", scale, 1.0), float)
    if not (np.isfinite(unit) & (unit > 0)).all():
        raise ValueError("scale must be finite and greater than 0")
    best, history, nonfinite, still = descend(
        options.optimizer,
        evaluate,
        x,
        task,
        problem.stages,
        unit,
        max_iterations=options.max_iterations,
        tolerance=options.tolerance,
        watch=watch,
    )
    if not history or not np.isfinite(min(history)):
        raise ValueError(NOT_FINITE)
    small = problem.form.size * len(x) * 8 <= JACOBIAN_BYTES and len(x) <= MOST_COLUMNS
    state = least_squares.start(best, problem.form.size, 1)
    if small:
        with np.errstate(all="ignore"):
            state = least_squares.advance(evaluate, LOSSES["linear"], state, task, 1)
    near = bool(small and state.offset <= 0.1)
    words = "converged" if near else "stopped before it converged: allow more iterations or start closer"
    if still and not near:
        words = "stopped: the loss stood still, but this is no minimum; use smaller steps, or optimizer=None"
    if watch.interrupted:
        words = "interrupted: the best so far"
    total = np.asarray(min(history) * max(int(np.sum(task.all_weights > 0)), 1))
    state = state._replace(x=best, total=total, nonfinite=np.asarray(nonfinite))
    sums = [h * np.sum(task.all_weights > 0) for h in history]
    return Outcome(report(problem, state, sums, 1.0, "linear", words, known), state)


def _best_start(problem, options, evaluate, task, x, watch) -> tuple[np.ndarray, dict[str, Any]]:
    """Where the best of many short searches ended, and all of them."""
    layout, n, m = problem.layout, len(x), problem.form.size
    if isinstance(options.starts, (int, np.integer)) and not isinstance(options.starts, bool):
        xs = drawn_starts(checks.count("starts", options.starts, least=1), x, task, evaluate)
    else:
        count = len(jax.tree.leaves(options.starts)[0])
        xs = np.stack(
            [np.asarray(layout.vector(jax.tree.map(lambda a, k=k: a[k], options.starts)), float) for k in range(count)]
        )
        xs = np.clip(xs, task.lower, task.upper)
    at_once = max(1, min(len(xs), JACOBIAN_BYTES // 4 // (8 * m * n)))
    states = many_starts(
        evaluate.both,
        LOSSES["linear"],
        xs,
        task,
        max_iterations=options.max_iterations,
        watch=watch,
        at_once=at_once,
    )
    size = max(int(np.sum(task.all_weights > 0)), 1)
    losses = np.array([state.total / size for state in states])
    if not np.isfinite(losses).any():
        raise ValueError(NOT_FINITE)
    every = jax.tree.map(lambda *a: jnp.stack(a), *[layout.params(jnp.asarray(s.x)) for s in states])
    return states[int(np.nanargmin(losses))].x, {"params": every, "loss": losses}


def drawn_starts(count: int, x: np.ndarray, task: Task, evaluate: Any) -> np.ndarray:
    """Starts about the given one, which is the first: within bounds, a factor of ten, or what changes the residual."""
    draw = np.random.default_rng(0)
    with np.errstate(all="ignore"):
        r, jacobian = evaluate.both(x, task.data)
        norms = np.asarray(least_squares.column_norms(np.asarray(jacobian, float)))
        reach = float(np.linalg.norm(np.asarray(r, float))) / norms
    reach = np.where(np.isfinite(reach) & (reach > 0), reach, np.where(x != 0, np.abs(x), 1.0))
    between = np.isfinite(task.lower) & np.isfinite(task.upper)
    positive = (task.lower >= 0) & (x > 0) & ~between
    xs = [x]
    for _ in range(count - 1):
        uniform = draw.uniform(size=len(x))
        about = x + reach * draw.normal(size=len(x))
        about = np.where(positive, x * 10 ** (2 * uniform - 1), about)
        about = np.where(between, task.lower + uniform * (task.upper - task.lower), about)
        xs.append(np.clip(about, task.lower, task.upper))
    return np.stack(xs)


def report(
    problem: Problem,
    state: State,
    history: list[float],
    spread: float,
    loss: str,
    words: str,
    known: Known,
    starts: Any = None,
    converged: bool | None = None,
) -> Fit:
    """What was found, with its errors and what is to be said about it."""
    layout, x = problem.layout, np.asarray(state.x)
    counted = np.asarray(problem.weights) > 0
    size = max(int(counted.sum()), 1)
    total = float(state.total)
    found = None
    if np.isfinite(state.jacobian).all() and state.jacobian.size:
        with np.errstate(all="ignore"):
            found = errors_of(problem, state, spread, loss)
    names, words_of = layout.names(), layout.names(readable)
    stderr = white = covariance = None
    blind: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    unresolved: tuple[str, ...] = ()
    if found is not None:
        error, plain = (
            np.where(found.blind, np.inf, np.sqrt(np.maximum(np.diag(c), 0))) for c in (found.covariance, found.white)
        )
        covariance = found.covariance
        stderr, white = (layout.params(jnp.asarray(e)) for e in (error, plain))
        undetermined = tuple(name for name, out in zip(names, found.blind, strict=True) if out)
        with np.errstate(all="ignore"):
            seen = directions(state.jacobian, problem.precision)
            blind = describe_blind(null_directions(seen), x, words_of, np.asarray(problem.lower) >= 0)
        doubtful = (problem.lower == 0) & (x > 0) & (error > x) & ~found.blind
        unresolved = tuple(np.asarray(words_of)[doubtful])
    at_bound = ((x <= problem.lower) & (problem.lower < problem.upper)) | (
        (x >= problem.upper) & (problem.lower < problem.upper)
    )
    rms = float(np.sqrt(total / max(size - len(x), 1)))
    explained = 1 - total / known.variance if known.variance else None
    noise = 1.0 if problem.absolute else known.noise
    ratio = rms / noise if noise else None
    rho = None if found is None or not np.isfinite(found.autocorrelation) else float(found.autocorrelation)
    verdict = Verdict(
        ending=words,
        nonfinite=int(state.nonfinite),
        blind=blind,
        at_bound=tuple(np.asarray(words_of)[at_bound]),
        unresolved=unresolved,
        explained=explained,
        noise_ratio=ratio,
        autocorrelation=rho,
        correlated=found is not None and bool(np.any(found.covariance != found.white)),
        sigma_given=problem.absolute,
        more=(*known.more, *_few(size, len(x)), *_kept(layout)),
    )
    return Fit(
        params=layout.params(jnp.asarray(x)),
        loss=total / size,
        history=np.asarray(history) / size,
        stderr=stderr,
        covariance=covariance,
        converged=words == "converged" if converged is None else converged,
        message=verdict.message(),
        undetermined=undetermined,
        nonfinite=int(state.nonfinite),
        stderr_white=white,
        residual=problem.form.params(jnp.asarray(state.residual)),
        blind=blind,
        at_bound=tuple(np.asarray(names)[at_bound]),
        explained=explained,
        noise_ratio=ratio,
        autocorrelation=rho,
        starts=starts,
    )


def _few(count: int, unknowns: int) -> tuple[str, ...]:
    """A word where hardly more is known than is asked."""
    if unknowns < count < 2 * unknowns:
        return (f"there are only {count} data for {unknowns} parameters: the errors are guesses; record more",)
    return ()


def _kept(layout: Layout) -> tuple[str, ...]:
    if not layout.kept:
        return ()
    return (f"{', '.join(layout.kept)} kept as given, an integer; write a float to fit it",)


def null_directions(seen: Any) -> np.ndarray:
    """Directions of the parameters that change nothing, (n, k)."""
    vectors = seen.vectors[:, seen.seen]
    _, _, vt = np.linalg.svd(vectors.T, full_matrices=True)
    return vt[vectors.shape[1] :].T / seen.norms[:, None]


def errors_of(problem: Problem, state: State, spread: Any, loss: str) -> Uncertainty:
    """Covariances at the end of a search; a robust loss counts an outlier by its influence."""
    xp = least_squares.namespace(state.x)
    _, slope = LOSSES[loss](state.residual / spread)
    jacobian = state.jacobian / xp.where(slope > 0, slope, 1)[:, None]
    curvature = LOSSES[loss].curvature(state.residual / spread)
    influence = state.residual * slope**2
    counted = problem.weights > 0
    absolute = problem.absolute and loss == "linear"
    return uncertainty(jacobian, influence, curvature, counted, series_of(problem.form), problem.precision, absolute)
