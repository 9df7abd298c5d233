"""The searches behind ``fit``, with values in hand: watched, interrupted and taken up again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.kept import Record
from jeuler.fitting.least_squares import Evaluate, State, Task, again, start
from jeuler.fitting.losses import LOSSES, Loss

ROUGH = 0.1  # standard errors: near enough for what is only a stage
TUNING = 1.345  # of a robust loss: 95 % as good as least squares where the noise is normal


@dataclasses.dataclass
class Watch:
    """What looks at a search between its iterations: a bar, and a file that it could go on from."""

    bar: Any
    record: Record | None = None
    interrupted: bool = False

    def see(self, stage: int, state: State, history: list[float], counted: bool) -> None:
        if counted:
            self.bar.update()
            self.bar.set_postfix_str(f"loss {history[-1]:.4g}" if history else "", refresh=False)
        if self.record is not None:
            self.record.save(stage, state, history)


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
    if watch.record is not None and (kept := watch.record.load()) is not None:
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
    with np.errstate(all="ignore"):
        while state.status == least_squares.RUNNING and state.iterations < len(state.history):
            before = state.iterations
            try:
                state = least_squares.advance(evaluate, loss, state, task, state.evaluations + 1)
                counted = bool(state.iterations > before)
                history += [float(state.total)] * counted
                watch.see(stage, state, history, counted)
            except KeyboardInterrupt:
                if np.isinf(state.cost):
                    raise
                watch.interrupted = True
                break
    return state


def _spread_of(residual: np.ndarray, weights: np.ndarray) -> float:
    """How large a residual may be that is no outlier, from the median of their sizes."""
    kept = np.abs(residual[weights > 0])
    middle = float(np.median(kept)) / 0.6745
    return TUNING * (middle if middle > 0 else float(np.sqrt(np.mean(kept**2))) or 1.0)


def many_starts(
    both: Callable[..., Any], loss: Loss, xs: np.ndarray, task: Task, *, max_iterations: int, watch: Watch, at_once: int
) -> list[State]:
    """A search from each of the starts; their residuals and Jacobians are evaluated ``at_once`` by one program."""
    batched = jax.jit(jax.vmap(both, in_axes=(0, None)))
    states = [start(x, len(task.weights), max_iterations) for x in xs]

    def goes_on(state: State) -> bool:
        return bool(state.status == least_squares.RUNNING and state.iterations < max_iterations)

    while running := [k for k, state in enumerate(states) if goes_on(state)]:
        for first in range(0, len(running), at_once):
            some = running[first : first + at_once]
            filled = [*some, *some[:1] * (at_once - len(some))]
            trials = np.stack([states[k].trial for k in filled])
            values, jacobians = (np.asarray(a, float) for a in batched(trials, task.data))
            for place, k in enumerate(some):
                known = _known(values[place], jacobians[place])
                with np.errstate(all="ignore"):
                    states[k] = least_squares.advance(known, loss, states[k], task, states[k].evaluations + 1)
        watch.bar.update()
    return states


def _known(value: np.ndarray, jacobian: np.ndarray) -> Evaluate:
    """An evaluation whose result is there already."""
    return Evaluate(lambda x, data: value, lambda x, data: (value, jacobian))  # type: ignore[arg-type,return-value]


def descend(
    optimizer: Any,
    evaluate: Evaluate,
    x: np.ndarray,
    task: Task,
    stages: Sequence[np.ndarray],
    scale: np.ndarray,
    *,
    max_iterations: int,
    tolerance: float,
    watch: Watch,
    patience: int = 50,
) -> tuple[np.ndarray, list[float], int, bool]:
    """Descend by an optax optimiser in x / scale. A step into non-finite values goes back to the best and is halved.

    Returns the best point over everything, the losses, how many points were not finite, and whether the loss stood
    still: no relative decrease above the tolerance in ``patience`` iterations.
    """
    import optax

    optimizer = optax.with_extra_args_support(optimizer)
    size = max(int(np.sum(task.all_weights > 0)), 1)
    lower, upper, unit = (jnp.asarray(a) for a in (task.lower / scale, task.upper / scale, scale))

    def losses(z, data, weights, all_weights):
        raw = evaluate.residual(z * unit, data)
        some, everything = (jnp.sum(jnp.where(w > 0, raw * w, 0) ** 2) for w in (weights, all_weights))
        return some / jnp.maximum(jnp.sum(weights > 0), 1), everything / size

    value_and_grad = jax.jit(jax.value_and_grad(losses, has_aux=True))

    @jax.jit
    def propose(z, state, value, grad, damping, data, weights, all_weights):
        updates, state = optimizer.update(
            grad, state, z, value=value, grad=grad, value_fn=lambda z: losses(z, data, weights, all_weights)[0]
        )
        z = optax.apply_updates(z, jax.tree.map(lambda u: damping * u, updates))
        return jnp.clip(z, lower, upper), state

    history: list[float] = []
    nonfinite, still = 0, False
    z = jnp.asarray(x / scale)
    best_ever, best_total = z, np.inf
    for number, weights in enumerate([*stages, task.all_weights]):
        last = number == len(stages)
        state, damping = optimizer.init(z), 1.0
        best, best_loss, since, still = z, np.inf, 0, False
        for _ in range(max_iterations if last else min(max_iterations, max_iterations // 4 + 10)):
            try:
                (loss, total), gradient = value_and_grad(z, task.data, weights, task.all_weights)
                if not (np.isfinite(loss) and np.isfinite(gradient).all()):
                    nonfinite += 1
                    if not np.isfinite(best_loss):
                        break
                    z, state, damping = best, optimizer.init(best), damping / 2
                    continue
                history.append(float(total) if np.isfinite(total) else np.inf)
                watch.bar.update()
                if total < best_total:
                    best_ever, best_total = z, float(total)
                since = 0 if loss < (1 - tolerance) * best_loss else since + 1
                if loss < best_loss:
                    best, best_loss = z, float(loss)
                still = loss == 0.0 or since >= patience
                if still:
                    break
                z, state = propose(z, state, loss, gradient, damping, task.data, weights, task.all_weights)
            except KeyboardInterrupt:
                if not history:
                    raise
                watch.interrupted = True
                break
        z = best
        if watch.interrupted:
            break
    return np.asarray(best_ever, float) * scale, history, nonfinite, bool(still)
