"""The way to a minimum that is near, by one Jacobian: for hundreds to thousands of unknowns started from the data.

    s = -(J^T J)^-1 J^T r(x),   x <- x + s,   J of where it began

The errors take the Jacobian once anyway, which takes longer than hundreds of products with it. Where the start is near,
that one leads to the minimum as well: with residuals of noise, what it has changed by on the way, a share c of itself,
leaves the end about c standard errors off.
"""

from __future__ import annotations

import numpy as np

from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import CONVERGED, State, Task, column_norms, start
from jeuler.fitting.many import weighted_jacobian
from jeuler.fitting.minimise import Watch

BENT = 0.05  # of the change of the residual, the most that the linear model may miss in the first step
LEFT = 0.01  # standard errors, root mean square over the unknowns: such a step is the last,
NEAR = 0.05  # and such a one where it makes nothing less, as the Jacobian is not of here
MOST_STEPS = 8


def from_nearby(
    evaluate: Evaluate, x: np.ndarray, task: Task, most: int, history: list[float], watch: Watch
) -> State | None:
    """The minimum and the Jacobian of the start; None where that is not near, or the user stopped it."""
    task = task._replace(weights=task.all_weights)
    try:
        jacobian = weighted_jacobian(evaluate, x, task.data, np.asarray(task.weights, float))
        if not np.isfinite(np.sum(jacobian)):
            return None
        return _descended(evaluate, x, jacobian, task, min(most, MOST_STEPS), history, watch)
    except KeyboardInterrupt:
        watch.interrupted = True
        return None


def _descended(
    evaluate: Evaluate, x: np.ndarray, jacobian: np.ndarray, task: Task, most: int, history: list[float], watch: Watch
) -> State | None:
    norms = column_norms(jacobian)
    unit = 1 / np.where(norms > 0, norms, 1)
    gram = (jacobian.T @ jacobian) * unit * unit[:, None]
    r, totals = _residual(evaluate, x, task), []
    freedom = max(int(np.sum(task.weights > 0)) - len(x), 1)
    for turn in range(most):
        s = _bounded(gram, (jacobian.T @ r) * unit, x, task, unit)
        if s is None:
            return None
        change = jacobian @ s
        trial = np.clip(x + s, task.lower, task.upper)
        after = _residual(evaluate, trial, task)
        bent = np.linalg.norm(after - r - change) > BENT * np.linalg.norm(change)
        if not np.isfinite(np.sum(after)) or (turn == 0 and bent):
            return None
        less = np.sum(after**2) <= np.sum(r**2)
        x, r = (trial, after) if less else (x, r)
        totals.append(float(np.sum(r**2)))
        watch.bar.update()
        size = np.sqrt(np.sum(change**2) / len(x) / max(totals[-1] / freedom, 1e-300))
        if size <= (LEFT if less else NEAR):
            history += totals
            return _ended(x, jacobian, norms, r, turn + 1)
        if not less:
            return None
    return None


def _ended(x: np.ndarray, jacobian: np.ndarray, norms: np.ndarray, r: np.ndarray, turns: int) -> State:
    total = np.asarray(np.sum(r**2))
    state = start(x, len(r), 1)._replace(jacobian=jacobian, scale=norms, residual=r, cost=total, total=total)
    return state._replace(iterations=np.asarray(turns), status=np.asarray(CONVERGED))


def _residual(evaluate: Evaluate, x: np.ndarray, task: Task) -> np.ndarray:
    with np.errstate(all="ignore"):
        r = np.asarray(evaluate.at(x, task.data)[0], float)
        return np.where(task.weights > 0, r * task.weights, 0)


def _bounded(gram: np.ndarray, slope: np.ndarray, x: np.ndarray, task: Task, unit: np.ndarray) -> np.ndarray | None:
    """The step to the minimum of the linear model; who would cross a bound stops there. None where that is singular."""
    from scipy.linalg import LinAlgError, solve

    low, high = (task.lower - x) / unit, (task.upper - x) / unit
    held = ((x <= task.lower) & (slope > 0)) | ((x >= task.upper) & (slope < 0))
    s = np.zeros_like(x)
    while not held.all():
        free, right = ~held, -slope - gram @ np.where(held, s, 0)
        try:
            s[free] = solve(gram[np.ix_(free, free)], right[free], assume_a="pos")
        except LinAlgError:
            return None
        outside = (s < low) | (s > high)
        if not outside.any():
            break
        s = np.where(outside, np.clip(s, low, high), np.where(held, s, 0))
        held |= outside
    return s * unit
