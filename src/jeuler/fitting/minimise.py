"""The searches behind ``fit``, with values in hand: watched, interrupted and taken up again."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.kept import SEARCH, Record
from jeuler.fitting.least_squares import State, Task, again, start
from jeuler.fitting.losses import LOSSES, Loss

ROUGH = 0.1  # standard errors: near enough for what is only a stage
TUNING = 1.345  # of a robust loss: 95 % as good as least squares where the noise is normal


@contextlib.contextmanager
def progress_bar(progress: bool | None, total: int):
    """A bar that counts the iterations of a fit; None shows it on a terminal."""
    from tqdm import tqdm

    with tqdm(total=total, desc="fit", disable=None if progress is None else not progress, leave=False) as bar:
        yield bar


@dataclasses.dataclass
class Watch:
    """What looks at a search between its iterations: a bar, and a file that it could go on from."""

    bar: Any
    record: Record | None = None
    interrupted: bool = False
    part: str = SEARCH

    def follow(self, advance: Callable[[Any], Any], state: Any, most: int, stage: int, history: list[float]) -> Any:
        """One search to its end, or to where it is interrupted; ``advance`` makes one step of it, taken or not."""
        try:
            while state.status == least_squares.RUNNING and state.iterations < most:
                if self.interrupted and np.isfinite(state.cost):
                    break  # among the starts: the best of them has been evaluated
                before = state.iterations
                state = advance(state)
                counted = bool(state.iterations > before)
                history += [float(state.total)] * counted
                self.see(stage, state, history, counted)
        except KeyboardInterrupt:
            if np.isinf(state.cost):
                raise
            self.interrupted = True
        return state

    def see(self, stage: int, state: Any, history: list[float], counted: bool) -> None:
        if counted:
            self.bar.update()
            self.bar.set_postfix_str(f"loss {history[-1]:.4g}" if history else "", refresh=False)
        if self.record is not None and not self.interrupted:
            self.record.save(stage, state, history, self.part)


@dataclasses.dataclass
class Found:
    """Where a search ended, and the losses on its way."""

    state: State
    history: list[float]
    spread: float = 1.0


def search(
    evaluate: Evaluate,
    loss: Loss,
    x: np.ndarray,
    task: Task,
    stages: Sequence[np.ndarray],
    *,
    max_iterations: int,
    watch: Watch,
    spread: float | None = None,
    noise: float | None = None,
) -> Found:
    """Levenberg-Marquardt through the stages, then over everything, then with a robust loss if there is one.

    ``spread`` None: the size beyond which a residual counts as an outlier is taken from the residuals themselves. A
    stage ends where its residual is that of the ``noise``: a few data would lead anywhere beyond that.
    """
    squares = LOSSES["linear"]
    robust: list[tuple[Loss, Any, float]] = []
    if loss.name != "linear":
        robust = [(loss, task.all_weights, task.tolerance)] * (1 if spread is not None else 3)
    plan: list[tuple[Loss, Any, float]] = [(squares, weights, ROUGH) for weights in stages]
    plan += [(squares, task.all_weights, task.tolerance if not robust else ROUGH), *robust]
    state, first = start(x, len(task.weights), max_iterations), 0
    history: list[float] = []
    if watch.record is not None and (kept := watch.record.load(state)) is not None:
        first, state, history = kept
    bend = 1.0
    for number, (own_loss, weights, tolerance) in enumerate(plan):
        if own_loss.name != "linear":
            bend = _spread_of(state.residual, task.all_weights) if spread is None else spread
        if number < first:
            continue
        enough = 1.5 * (noise or 0.0) ** 2 * np.sum(weights > 0) if number < len(stages) else 0.0
        now = task._replace(weights=weights, tolerance=np.asarray(tolerance), spread=np.asarray(bend))
        now = now._replace(enough=np.asarray(enough))
        state = state if number == first else again(state)
        state = _through(evaluate, own_loss, state, now, number, history, watch)
        if watch.interrupted or state.status == least_squares.NOT_FINITE:
            break
    return Found(state, history, bend)


def _through(
    evaluate: Evaluate, loss: Loss, state: State, task: Task, stage: int, history: list[float], watch: Watch
) -> State:
    """One search to its end."""

    def advance(state: State) -> State:
        return least_squares.advance(evaluate, loss, state, task, state.evaluations + 1)

    with np.errstate(all="ignore"):
        return watch.follow(advance, state, len(state.history), stage, history)


def _spread_of(residual: np.ndarray, weights: np.ndarray) -> float:
    """How large a residual may be that is no outlier, from the median of their sizes."""
    kept = np.abs(residual[weights > 0])
    middle = float(np.median(kept)) / 0.6745
    return TUNING * (middle if middle > 0 else float(np.sqrt(np.mean(kept**2))) or 1.0)
