"""The report of a search as a `Fit`: best parameters, standard errors and message."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.beside import attach
from jeuler.fitting.blind import describe_blind
from jeuler.fitting.errors import BLIND
from jeuler.fitting.factors import namespace
from jeuler.fitting.least_squares import State
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.many import uncertainty_of_many
from jeuler.fitting.minimise import Watch
from jeuler.fitting.options import Known
from jeuler.fitting.problem import MOST_COLUMNS, Problem, series_of
from jeuler.fitting.result import Fit, Verdict
from jeuler.fitting.uncertainty import Uncertainty, uncertainty
from jeuler.fitting.unknowns import Layout

INVERSE = "inverse"  # under this name that of J^T J is kept beside a result of many unknowns
NOT_FINITE = (
    "the residual is not finite at the start of the fit, nor at any point that was tried; "
    "start closer, or use a smaller dt or a stabler step"
)


def ending(state: Any, watch: Watch | None = None) -> str:
    """How a search ended, in words, from its state."""
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


def report(
    problem: Problem,
    state: State,
    history: list[float],
    spread: float,
    loss: str,
    words: str,
    known: Known,
    starts: Any = None,
) -> Fit:
    """The best parameters with their standard errors and a message; ``words`` say how the search ended."""
    layout, x = problem.layout, np.asarray(state.x)
    size = max(int(np.sum(np.asarray(problem.weights) > 0)), 1)
    total = float(state.total)
    errors = _errors(problem, state, spread, loss)
    held = ((x <= problem.lower) | (x >= problem.upper)) & (problem.lower < problem.upper)
    rms = float(np.sqrt(total / max(size - len(x), 1)))
    noise = 1.0 if problem.absolute else known.noise
    quality: dict[str, Any] = {
        "explained": 1 - total / known.variance if known.variance else None,
        "noise_ratio": rms / noise if noise else None,
        "autocorrelation": errors.autocorrelation,
    }
    apart = ("the errors are not those of a minimum",) if words != "converged" and errors.stderr is not None else ()
    verdict = Verdict(
        ending=words,
        nonfinite=int(state.nonfinite),
        blind=errors.blind,
        at_bound=tuple(np.asarray(layout.names())[held].tolist()),
        unresolved=errors.unresolved,
        correlated=errors.correlated,
        sigma_given=problem.absolute,
        more=(*apart, *known.more, *_few(size, len(x), problem.absolute), *_kept(layout)),
        **quality,
    )
    fit = Fit(
        params=layout.params(x),
        loss=total / size,
        history=np.asarray(history) / size,
        stderr=errors.stderr,
        covariance=errors.covariance,
        converged=words == "converged",
        message=verdict.message(),
        undetermined=errors.undetermined,
        nonfinite=int(state.nonfinite),
        stderr_white=errors.white,
        residual=problem.of_data(np.asarray(state.residual)),
        blind=errors.blind,
        at_bound=verdict.at_bound,
        starts=starts,
        **quality,
    )
    attach(fit, INVERSE, errors.inverse)
    attach(fit, BLIND, errors.null)
    return fit


class _Errors(NamedTuple):
    """Standard errors and what the data do not determine, as a `Fit` has them; the defaults where none were found."""

    stderr: Any = None
    white: Any = None
    covariance: Any = None
    undetermined: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    unresolved: tuple[str, ...] = ()  # positive parameters whose error is larger than their value
    autocorrelation: float | None = None
    correlated: bool = False
    inverse: Any = None  # of J^T J
    null: Any = None  # the blind directions, (n, k)


def _errors(problem: Problem, state: State, spread: float, loss: str) -> _Errors:
    """The errors of a search with values in hand."""
    if not (state.jacobian.size and np.isfinite(state.jacobian).all()):
        return _Errors()
    layout, x, names = problem.layout, np.asarray(state.x), np.asarray(problem.layout.names())
    free = problem.lower < problem.upper  # the others are held where they are, without an error
    some = state if free.all() else state._replace(x=x[free], jacobian=state.jacobian[:, free])
    with np.errstate(all="ignore"):
        found = errors_of(problem, some, spread, loss)
        error, white = np.zeros((2, len(x)))
        for each, c in ((error, found.covariance), (white, found.white)):
            each[free] = np.where(found.blind, np.inf, np.sqrt(np.maximum(np.diag(c), 0)))
        null = found.directions.null()
        blind = describe_blind(null, x[free], tuple(names[free]), np.asarray(problem.lower)[free] >= 0)
    doubtful = (problem.lower == 0) & (x > 0) & (error > x) & np.isfinite(error)
    return _Errors(
        stderr=layout.params(error),
        white=layout.params(white),
        covariance=_with_held(found.covariance, free, free),
        undetermined=tuple(names[free][found.blind].tolist()),
        blind=blind,
        unresolved=tuple(names[doubtful].tolist()),
        autocorrelation=float(found.autocorrelation) if np.isfinite(found.autocorrelation) else None,
        correlated=bool(np.any(found.covariance != found.white)),
        inverse=None if found.inverse is None else _with_held(found.inverse, free, free),
        null=_with_held(null, free, np.ones(null.shape[1], bool)),
    )


def _with_held(some: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A matrix of what is free with zeros for what is held."""
    whole = np.zeros((len(rows), len(columns)))
    whole[np.ix_(rows, columns)] = some
    return whole


def _few(count: int, unknowns: int, absolute: bool) -> tuple[str, ...]:
    """A word where hardly more is known than is asked."""
    if unknowns < count < 2 * unknowns:
        return (f"there are only {count} data for {unknowns} parameters: the errors are guesses; record more",)
    if count <= unknowns and not absolute:
        return (f"there are only {count} data for {unknowns} parameters: no errors without sigma; record more",)
    return ()


def _kept(layout: Layout) -> tuple[str, ...]:
    if not layout.kept:
        return ()
    return (f"{', '.join(layout.kept)} kept as given, an integer; write a float to fit it",)


def errors_of(problem: Problem, state: State, spread: Any, loss: str) -> Uncertainty:
    """Covariances at the end of a search; a robust loss counts an outlier by its influence."""
    xp = namespace(state.x)
    _, slope = LOSSES[loss](state.residual / spread)
    jacobian = state.jacobian if loss == "linear" else state.jacobian / xp.where(slope > 0, slope, 1)[:, None]
    curvature = LOSSES[loss].curvature(state.residual / spread)
    influence = state.residual * slope**2
    counted = problem.weights > 0
    absolute = problem.absolute and loss == "linear"
    series, fixed = series_of(problem.form), 0
    if problem.residual.priors is not None:  # the last rows
        series, fixed = series[:-1], len(problem.residual.priors.places)
    if xp is np and len(state.x) > MOST_COLUMNS:
        return uncertainty_of_many(jacobian, influence, curvature, counted, series, absolute, fixed)
    return uncertainty(jacobian, influence, curvature, counted, series, problem.precision, absolute, fixed)
