"""Fits by an optax optimiser."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.fitting import least_squares
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import State, Task
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.minimise import Watch
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import Problem
from jeuler.fitting.report import NOT_FINITE, report
from jeuler.fitting.result import Fit

NEAR = 0.1  # standard errors from the minimum, by the linear model, at which a descent has converged
PATIENCE = 50  # iterations without a decrease after which the loss stands still
GOES_ON, STILL, LOST = range(3)


def by_optax(
    problem: Problem,
    options: Options,
    evaluate: Evaluate,
    task: Task,
    x: np.ndarray,
    scale: Any,
    watch: Watch,
    known: Known,
) -> tuple[Fit, State, bool]:
    """The fit by an optax optimiser, where it ended, and whether the user stopped it."""
    unit = np.asarray(problem.layout.spread("scale", scale, 1.0), float)
    if not (np.isfinite(unit) & (unit > 0)).all():
        raise ValueError("scale must be finite and greater than 0")
    descent = Descent(options.optimizer, evaluate, task, unit, options.tolerance, watch)
    if options.minibatch is not None:
        from jeuler.fitting.minibatches import by_minibatches

        place = by_minibatches(descent, problem.windows or problem, options.minibatch, x, options.max_iterations)
    else:
        place = descent.run(x, problem.stages, options.max_iterations)
    best, least = np.asarray(place.best_of_all, float) * unit, place.least_of_all
    if not np.isfinite(least):
        raise ValueError(NOT_FINITE)
    state = least_squares.start(best, problem.form.size if problem.small else 0, 1)
    if not problem.small:
        raw = np.asarray(evaluate.residual(jnp.asarray(best), task.data)).astype(float)
        state = state._replace(residual=np.where(task.all_weights > 0, raw * task.all_weights, 0))
    else:
        with np.errstate(all="ignore"):
            state = least_squares.advance(evaluate, LOSSES["linear"], state, task, 1)
    near = bool(problem.small and state.offset <= NEAR)
    words = "converged" if near else "stopped before it converged: allow more iterations or start closer"
    if place.status == STILL and not near:
        words = "stopped: the loss stood still, but this is no minimum; use smaller steps, or optimizer=None"
    if watch.interrupted:
        words = "interrupted: the best so far"
    total = np.asarray(least * max(int(np.sum(task.all_weights > 0)), 1))
    state = state._replace(x=best, total=total, nonfinite=np.asarray(place.nonfinite))
    sums = [h * np.sum(task.all_weights > 0) for h in descent.history]
    return report(problem, state, sums, 1.0, "linear", words, known), state, watch.interrupted


class Place(NamedTuple):
    """Where a descent is, in z = x / unit: numbers from which all that follows can be had again.

    Attributes:
      z, state: the point, and what the optimizer knows there.
      damping: of its steps.
      best, least: the best point for the data that the stage weights, and its loss.
      since: iterations (passes, of minibatches) without a decrease.
      turns: iterations of this stage.
      best_of_all, least_of_all: the best point over all the data, of all stages, and its loss.
      nonfinite: how many points were not finite.
      status: whether it goes on, stands still (no relative decrease above the tolerance in 50 iterations), or is lost.
    """

    z: Array
    state: Any
    damping: float
    best: Array
    least: float
    since: int
    turns: int
    best_of_all: Array
    least_of_all: float
    nonfinite: int
    status: int

    def looked_at(self, total: float) -> Place:
        """With the loss over all the data."""
        return self._replace(best_of_all=self.z, least_of_all=total) if total < self.least_of_all else self

    def stepped_back(self, init: Callable[[Any], Any], to: Array, least: float) -> Place:
        """Back from values that are not finite to the best point, with half the steps; lost where there is none."""
        place = self._replace(nonfinite=self.nonfinite + 1, status=self.status if np.isfinite(least) else LOST)
        return place._replace(z=to, state=init(to), damping=self.damping / 2)


class Descent:
    """A descent in z = x / unit. A step into values that are not finite goes back to the best and is halved.

    Attributes:
      history: the loss over all the data after each iteration.
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

    def run(self, x: np.ndarray, stages: Sequence[np.ndarray], max_iterations: int) -> Place:
        """Through the stages, then over everything."""
        first, place = self.beginning(x)
        plan = [(weights, min(max_iterations, max_iterations // 4 + 10)) for weights in stages]
        for number, (weights, most) in enumerate([*plan, (self.task.all_weights, max_iterations)]):
            if number > first:
                z = place.best
                place = place._replace(z=z, state=self.init(z), damping=1.0, least=np.inf, since=0, turns=0)
                place = place._replace(status=GOES_ON)
            if number >= first:
                data = self.task.data, weights, self.task.all_weights
                place = self.follow(place, number, most, functools.partial(self._iterate, data))
        return place

    def beginning(self, x: np.ndarray) -> tuple[int, Place]:
        """The stage and the place to begin at: those of the file that it goes on from, with the history until there."""
        z = jnp.asarray(x / self.unit)
        place = Place(z, self.init(z), 1.0, z, np.inf, 0, 0, z, np.inf, 0, GOES_ON)
        record = self.watch.record
        if record is None or (kept := record.load(place)) is None:
            return 0, place
        stage, place, self.history = kept
        return stage, place

    def follow(
        self, place: Place, stage: int, most: int, iterate: Callable[[Place], tuple[Place, list[float]]]
    ) -> Place:
        """To the end of a stage, or to where the user stops it; ``iterate`` also gives what it saw of the loss."""
        watch = self.watch
        try:
            while place.status == GOES_ON and place.turns < most and not watch.interrupted:
                place, seen = iterate(place)
                self.history += seen
                watch.bar.update(len(seen))
                if watch.record is not None:
                    watch.record.save(stage, place, self.history)
        except KeyboardInterrupt:
            if not self.history:
                raise
            watch.interrupted = True
        return place

    def _iterate(self, data: tuple[Any, ...], place: Place) -> tuple[Place, list[float]]:
        """One step over what is weighted, and the loss over everything before it."""
        (loss, total), gradient = self._value_and_grad(place.z, *data)
        place = place._replace(turns=place.turns + 1)
        if not (np.isfinite(loss) and np.isfinite(gradient).all()):
            return place.stepped_back(self.init, place.best, place.least), []
        loss, total = float(loss), float(total) if np.isfinite(total) else np.inf
        place = place.looked_at(total)
        place = place._replace(since=0 if loss < (1 - self.tolerance) * place.least else place.since + 1)
        if loss < place.least:
            place = place._replace(best=place.z, least=loss)
        if loss == 0.0 or place.since >= PATIENCE:
            return place._replace(status=STILL), [total]
        z, state = self._propose(place.z, place.state, loss, gradient, place.damping, *data)
        return place._replace(z=z, state=state), [total]
