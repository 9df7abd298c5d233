"""Fits by an optax optimiser."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import State, Task
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minibatches import Minibatches
from jeuler.fitting.minimise import Watch
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import Problem
from jeuler.fitting.report import NOT_FINITE, report
from jeuler.fitting.result import Fit

PATIENCE = 50  # iterations without a decrease after which the loss stands still


def by_optax(
    problem: Problem,
    options: Options,
    evaluate: Evaluate,
    task: Task,
    x: np.ndarray,
    scale: Any,
    watch: Watch,
    known: Known,
) -> tuple[Fit, State]:
    """The fit by an optax optimiser, and where it ended."""
    unit = np.asarray(problem.layout.spread("scale", scale, 1.0), float)
    if not (np.isfinite(unit) & (unit > 0)).all():
        raise ValueError("scale must be finite and greater than 0")
    descent: Descent | Minibatches = Descent(options.optimizer, evaluate, task, unit, options.tolerance, watch)
    if options.minibatch is not None:
        descent = Minibatches(descent, problem.windows or problem, options.minibatch)
    best = descent.run(x, problem.stages, options.max_iterations)
    history = descent.history
    if not history or not np.isfinite(min(history)):
        raise ValueError(NOT_FINITE)
    state = least_squares.start(best, problem.form.size if problem.small else 0, 1)
    if not problem.small:
        raw = np.asarray(evaluate.residual(jnp.asarray(best), task.data)).astype(float)
        state = state._replace(residual=np.where(task.all_weights > 0, raw * task.all_weights, 0))
    else:
        with np.errstate(all="ignore"):
            state = least_squares.advance(evaluate, LOSSES["linear"], state, task, 1)
    near = bool(problem.small and state.offset <= 0.1)
    words = "converged" if near else "stopped before it converged: allow more iterations or start closer"
    if descent.still and not near:
        words = "stopped: the loss stood still, but this is no minimum; use smaller steps, or optimizer=None"
    if watch.interrupted:
        words = "interrupted: the best so far"
    total = np.asarray(min(history) * max(int(np.sum(task.all_weights > 0)), 1))
    state = state._replace(x=best, total=total, nonfinite=np.asarray(descent.nonfinite))
    sums = [h * np.sum(task.all_weights > 0) for h in history]
    return report(problem, state, sums, 1.0, "linear", words, known), state


class Descent:
    """A descent in z = x / unit. A step into values that are not finite goes back to the best and is halved.

    Attributes:
      history: the loss over all the data after each iteration.
      nonfinite: how many points were not finite.
      still: whether the loss stood still at the end: no relative decrease above the tolerance in 50 iterations.
    """

    def __init__(
        self, optimizer: Any, evaluate: Evaluate, task: Task, unit: np.ndarray, tolerance: float, watch: Watch
    ):
        import optax

        optimizer = optax.with_extra_args_support(optimizer)
        size = max(int(np.sum(task.all_weights > 0)), 1)
        scale, lower, upper = (jnp.asarray(a) for a in (unit, task.lower / unit, task.upper / unit))

        def losses(z, data, weights, all_weights):
            raw = evaluate.residual(z * scale, data)
            some, everything = (jnp.sum(jnp.where(w > 0, raw * w, 0) ** 2) for w in (weights, all_weights))
            return some / jnp.maximum(jnp.sum(weights > 0), 1), everything / size

        def propose(losses, z, state, value, grad, damping, *data):
            updates, state = optimizer.update(
                grad, state, z, value=value, grad=grad, value_fn=lambda z: losses(z, *data)[0]
            )
            z = optax.apply_updates(z, jax.tree.map(lambda u: damping * u, updates))
            return jnp.clip(z, lower, upper), state

        self.losses: Callable[..., Any] = jax.jit(losses)
        self._value_and_grad = jax.jit(jax.value_and_grad(losses, has_aux=True))
        self.propose: Callable[..., Any] = propose
        self._propose = jax.jit(functools.partial(propose, losses))
        self.init: Callable[[Any], Any] = optimizer.init
        self.task: Task = task
        self.unit: np.ndarray = unit
        self.tolerance: float = tolerance
        self.watch: Watch = watch
        self.history: list[float] = []
        self.nonfinite: int = 0
        self.still: bool = False

    def run(self, x: np.ndarray, stages: Sequence[np.ndarray], max_iterations: int) -> np.ndarray:
        """Through the stages, then over everything: the best point over everything."""
        z = jnp.asarray(x / self.unit)
        self.best: Any = z  # over all the data, of all stages
        self.least: float = np.inf
        for weights in stages:
            z = self._stage(z, weights, min(max_iterations, max_iterations // 4 + 10))
        self._stage(z, self.task.all_weights, max_iterations)
        return np.asarray(self.best, float) * self.unit

    def _stage(self, z: Any, weights: np.ndarray, max_iterations: int) -> Any:
        """Down to where the loss over what is weighted stands still: the best point for that."""
        data = self.task.data, weights, self.task.all_weights
        state, damping = self.init(z), 1.0
        best, least, since, self.still = z, np.inf, 0, False
        for _ in range(0 if self.watch.interrupted else max_iterations):
            try:
                (loss, total), gradient = self._value_and_grad(z, *data)
                if not (np.isfinite(loss) and np.isfinite(gradient).all()):
                    self.nonfinite += 1
                    if not np.isfinite(least):
                        break
                    z, state, damping = best, self.init(best), damping / 2
                    continue
                self.count(z, float(total))
                since = 0 if loss < (1 - self.tolerance) * least else since + 1
                if loss < least:
                    best, least = z, float(loss)
                self.still = bool(loss == 0.0 or since >= PATIENCE)
                if self.still:
                    break
                z, state = self._propose(z, state, loss, gradient, damping, *data)
            except KeyboardInterrupt:
                if not self.history:
                    raise
                self.watch.interrupted = True
                break
        return best

    def count(self, z: Any, total: float) -> None:
        self.history.append(total if np.isfinite(total) else np.inf)
        self.watch.bar.update()
        if total < self.least:
            self.best, self.least = z, total
