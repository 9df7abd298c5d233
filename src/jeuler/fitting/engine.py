"""From a checked problem to a `Fit`: which search is run, and what is kept of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jeuler.fitting.beside import attach
from jeuler.fitting.density import Density
from jeuler.fitting.descent import by_optax
from jeuler.fitting.kept import Record
from jeuler.fitting.least_squares import CONVERGED, ROUNDED, State, Task, advance, start
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minimise import TUNING, Watch, progress_bar, search
from jeuler.fitting.observations import variance_of
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import Problem, marks, programs, variance_of_noise
from jeuler.fitting.profiles import AGAIN, Again, Ended
from jeuler.fitting.report import NOT_FINITE, ending, report
from jeuler.fitting.result import DENSITY, Fit
from jeuler.fitting.starts import best_start

PyTree = Any
MOST_ITERATIONS = 200  # of a search with one parameter held


class Outcome(NamedTuple):
    """A fit, where its search ended (None where that was traced), and whether the user stopped it."""

    fit: Fit
    state: State | None
    interrupted: bool = False


def run(problem: Problem, options: Options, *, scale: PyTree = None, known: Known | None = None) -> Outcome:
    """Search, and report."""
    if problem.traced:
        from jeuler.fitting.traced import run_traced

        return Outcome(run_traced(problem, options, scale), None)
    evaluate, task = programs(problem.residual, problem.data), problem.task(options.tolerance)
    x = np.asarray(problem.x, float)
    known = known or Known(_variance(problem, evaluate, x))
    if not problem.small and options.optimizer is None:
        from jeuler.fitting.matrix_free import run_matrix_free

        return Outcome(*run_matrix_free(problem, options, evaluate, known))
    record = Record.of(options.resume, lambda: (marks(problem, options, task), scale))
    starts = None
    with progress_bar(options.progress, options.max_iterations * (len(problem.stages) + 1)) as bar:
        watch = Watch(bar, record)
        if options.optimizer is not None:
            return Outcome(*by_optax(problem, options, evaluate, task, x, scale, watch, known))
        if options.starts is not None:
            x, starts = best_start(problem, options, evaluate, task, x, watch)
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
    held = np.asarray(problem.lower >= problem.upper)
    state = found.state
    if held.any():  # what is held has no part in the bias of the others
        state = state._replace(jacobian=np.where(held, 0, state.jacobian), scale=np.where(held, 0, state.scale))
    if not np.isfinite(state.cost):
        raise ValueError(NOT_FINITE)
    words = ending(state, watch)
    fit = report(problem, state, found.history, found.spread, options.loss, words, known, starts)
    if fit.stderr is not None:
        task = task._replace(spread=np.asarray(found.spread))
        attach(fit, AGAIN, _again(problem, evaluate, options.loss, task, state, fit))
    attach(fit, DENSITY, Density.of(problem, options.loss, state.residual, found.spread))
    return Outcome(fit, state, watch.interrupted)


def _variance(problem: Problem, evaluate: Any, x: np.ndarray) -> float | None:
    """Weighted sum of squares of the data about their means, where the residual is a model minus all of them."""
    shapes = [shape for shape in problem.form.shapes if shape is not None]
    shapes = shapes if problem.residual.priors is None else shapes[:-1]
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(problem.data)]
    if not problem.small or [leaf.shape for leaf in leaves] != shapes or any(leaf.dtype.kind != "f" for leaf in leaves):
        return None
    flat = np.concatenate([leaf.ravel() for leaf in leaves]).astype(float)
    moved = jax.tree.map(lambda leaf: np.asarray(leaf) + (1 + np.abs(leaf)), problem.data)
    before, after = (evaluate.at(x, data)[0][: len(flat)] for data in (problem.data, moved))
    if not np.allclose(before - after, 1 + np.abs(flat), rtol=1e-3, atol=0):
        return None
    weights, total = np.asarray(problem.weights, float)[: len(flat)], 0.0
    for leaf, own in zip(leaves, np.split(weights, np.cumsum([leaf.size for leaf in leaves])[:-1]), strict=True):
        shape = (len(leaf), -1) if leaf.ndim else (1, 1)
        total += variance_of(leaf.reshape(shape).astype(float), own.reshape(shape)) or 0.0
    return total or None


def _again(problem: Problem, evaluate: Any, loss: str, task: Task, state: State, fit: Fit) -> Again:
    """What a profile needs of this fit."""
    error, white = (np.asarray(problem.layout.vector(e), float) for e in (fit.stderr, fit.stderr_white))

    def search(task: Task, x: np.ndarray) -> Ended:
        with np.errstate(all="ignore"):
            fresh = start(x, len(state.residual), MOST_ITERATIONS)
            found = advance(evaluate, LOSSES[loss], fresh, task, 1_000_000)
        return Ended(found.x, float(found.cost), bool(found.status in (CONVERGED, ROUNDED)))

    def follows(k: int) -> np.ndarray:
        return np.eye(1, len(state.x), k)[0]

    variance = variance_of_noise(problem, task, state)
    return Again(problem.layout, task, state.x, search, lambda k: (error[k], white[k]), follows, variance)
