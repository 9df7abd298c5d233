"""Searches from many starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.fitting import least_squares
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.kept import STARTS
from jeuler.fitting.least_squares import State, Task, start
from jeuler.fitting.losses import LOSSES, Loss
from jeuler.fitting.minimise import Watch
from jeuler.fitting.options import Options
from jeuler.fitting.problem import JACOBIAN_BYTES, Problem
from jeuler.fitting.report import NOT_FINITE
from jeuler.fitting.unknowns import Layout


def best_start(
    problem: Problem, options: Options, evaluate: Evaluate, task: Task, x: np.ndarray, watch: Watch
) -> tuple[np.ndarray, dict[str, Any]]:
    """Where the best of many short searches ended, and all of them."""
    n, m = len(x), problem.form.size

    def reach() -> Any:
        with np.errstate(all="ignore"):
            r, jacobian = evaluate.both(jnp.asarray(x), task.data)
            norms = np.asarray(least_squares.column_norms(np.asarray(jacobian, float)))
            return np.linalg.norm(np.asarray(r, float)) / norms

    if watch.record is not None and watch.record.all_ends is not None:
        return best_of(problem, *watch.record.all_ends)
    xs = starts_of(problem.layout, options, x, task, reach)
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
    ends = np.stack([state.x for state in states]), np.array([float(state.total) for state in states])
    if watch.record is not None:
        watch.record.ends = ends
    return best_of(problem, *ends)


def starts_of(layout: Layout, options: Options, x: np.ndarray, task: Task, reach: Callable[[], Any]) -> np.ndarray:
    """The starts that were asked for, (start, n), within the bounds."""
    if isinstance(options.starts, (int, np.integer)) and not isinstance(options.starts, bool):
        return drawn_starts(checks.count("starts", options.starts, least=1), x, task, reach())
    count = _count_of(options.starts, layout)
    xs = [np.asarray(layout.vector(jax.tree.map(lambda a, k=k: a[k], options.starts)), float) for k in range(count)]
    return np.asarray(np.clip(np.stack(xs), task.lower, task.upper))


def best_of(problem: Problem, xs: np.ndarray, totals: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Where the best of some searches ended, and all of them."""
    size = max(int(np.sum(np.asarray(problem.weights) > 0)), 1)
    losses = totals / size
    if not np.isfinite(losses).any():
        raise ValueError(NOT_FINITE)
    every = jax.tree.map(lambda *a: jnp.stack(a), *[problem.layout.params(jnp.asarray(x)) for x in xs])
    return xs[int(np.nanargmin(losses))], {"params": every, "loss": losses}


def _count_of(starts: Any, layout: Layout) -> int:
    """How many starts a tree of them holds, or one ValueError."""
    leaves, structure = jax.tree.flatten(starts)
    shapes = [np.shape(leaf) for leaf in leaves]
    counts = {shape[0] if shape else 0 for shape in shapes}
    if structure != layout.structure or len(counts) != 1 or not min(counts):
        raise ValueError(
            f"starts must be a number of starts, or a tree like params whose arrays have one more axis in front, one "
            f"row a start, got {checks.shown(starts)}; write starts=64"
        )
    return int(min(counts))


def drawn_starts(count: int, x: np.ndarray, task: Task, reach: np.ndarray) -> np.ndarray:
    """Starts about the given one, which is the first: within bounds, a factor of ten, or what changes the residual."""
    draw = np.random.default_rng(0)
    reach = np.where(np.isfinite(reach) & (reach > 0), reach, np.where(x != 0, np.abs(x), 1.0))
    between = np.isfinite(task.lower) & np.isfinite(task.upper)
    low, high = np.where(between, task.lower, 0), np.where(between, task.upper, 0)
    positive = (task.lower >= 0) & (x > 0) & ~between
    xs = [x]
    for _ in range(count - 1):
        uniform = draw.uniform(size=len(x))
        about = x + reach * draw.normal(size=len(x))
        about = np.where(positive, x * 10 ** (2 * uniform - 1), about)
        about = np.where(between, low + uniform * (high - low), about)
        xs.append(np.clip(about, task.lower, task.upper))
    return np.stack(xs)


def many_starts(
    both: Callable[..., Any], loss: Loss, xs: np.ndarray, task: Task, *, max_iterations: int, watch: Watch, at_once: int
) -> list[State]:
    """A search from each of the starts; their residuals and Jacobians are evaluated ``at_once`` by one program."""
    batched = jax.jit(jax.vmap(both, in_axes=(0, None)))
    states = [start(x, len(task.weights), max_iterations) for x in xs]
    if watch.record is not None and (kept := watch.record.load(states, STARTS)) is not None:
        states = kept[1]

    def goes_on(state: State) -> bool:
        return bool(state.status == least_squares.RUNNING and state.iterations < max_iterations)

    def turn(running: list[int]) -> None:
        for first in range(0, len(running), at_once):
            some = running[first : first + at_once]
            filled = [*some, *some[:1] * (at_once - len(some))]
            trials = np.stack([states[k].trial for k in filled])
            values, jacobians = (np.asarray(a, float) for a in batched(trials, task.data))
            for place, k in enumerate(some):
                known = _known(values[place], jacobians[place])
                with np.errstate(all="ignore"):
                    states[k] = least_squares.advance(known, loss, states[k], task, states[k].evaluations + 1)

    try:
        while running := [k for k, state in enumerate(states) if goes_on(state)]:
            turn(running)
            watch.bar.update()
            if watch.record is not None:
                watch.record.save(0, states, [], STARTS)
    except KeyboardInterrupt:
        if not any(np.isfinite(state.cost) for state in states):
            raise
        watch.interrupted = True
    return states


def _known(value: np.ndarray, jacobian: np.ndarray) -> Evaluate:
    """An evaluation whose result is there already."""
    return Evaluate(lambda x, data: value, lambda x, data: (value, jacobian), lambda x, data: (value, lambda: jacobian))  # type: ignore[arg-type,return-value]
