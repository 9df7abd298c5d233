"""Descent by some rows of the data at a time."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.fitting.problem import Problem

PATIENCE = 50  # passes over the data without a decrease after which the loss stands still


class Minibatches:
    """A descent whose steps look at some rows of the data each; all of them are looked at after each pass.

    Attributes:
      history, nonfinite, still: as in `Descent`, which counts them.
    """

    def __init__(self, descent: Any, problem: Problem, size: int):
        self.descent: Any = descent
        self.data: Any = problem.data
        self.weights: Any = np.asarray(problem.weights, float)
        self.size: int = size
        self.rows: int = _rows_of(problem, size)
        rows, scale, residual = self.rows, jnp.asarray(descent.unit), problem.residual
        shapes = [shape for shape in problem.form.shapes if shape is not None]
        ends = np.cumsum([math.prod(shape) for shape in shapes])

        def losses(z, data, weights, index):
            some = jax.tree.map(lambda a: jnp.asarray(a)[index], data)
            own = [w.reshape(rows, -1)[index].ravel() for w in jnp.split(weights, ends[:-1])]
            weight = jnp.concatenate(own)
            loss = jnp.sum(jnp.where(weight > 0, residual(z * scale, some) * weight, 0) ** 2)
            loss = loss / jnp.maximum(jnp.sum(weight > 0), 1)
            return loss, loss

        self._value_and_grad = jax.jit(jax.value_and_grad(losses, has_aux=True))
        self._propose = jax.jit(functools.partial(descent.propose, losses))

    @property
    def history(self) -> list[float]:
        return self.descent.history

    @property
    def nonfinite(self) -> int:
        return self.descent.nonfinite

    @property
    def still(self) -> bool:
        return self.descent.still

    def run(self, x: np.ndarray, stages: Sequence[np.ndarray], max_iterations: int) -> np.ndarray:
        """Passes over the data: the best point over everything after one of them."""
        descent, passes = self.descent, -(-self.rows // self.size)
        weights, draw = self.weights, np.random.default_rng(0)
        z = jnp.asarray(x / descent.unit)
        descent.best, descent.least = z, np.inf
        state, damping, since, order = descent.init(z), 1.0, 0, np.zeros(0, int)
        try:
            for n in range(max_iterations):
                if n % passes == 0:
                    before = descent.least
                    if not self._look(z):
                        if not np.isfinite(descent.least):
                            break
                        z, state, damping = descent.best, descent.init(descent.best), damping / 2
                    since = 0 if descent.least < (1 - descent.tolerance) * before else since + 1
                    descent.still = descent.least == 0.0 or since >= PATIENCE
                    if descent.still:
                        break
                    order = np.resize(draw.permutation(self.rows), passes * self.size)
                index = order[n % passes * self.size :][: self.size]
                (loss, _), gradient = self._value_and_grad(z, self.data, weights, index)
                if not (np.isfinite(loss) and np.isfinite(gradient).all()):
                    descent.nonfinite += 1
                    z, state, damping = descent.best, descent.init(descent.best), damping / 2
                    continue
                z, state = self._propose(z, state, loss, gradient, damping, self.data, weights, index)
            if not descent.still:
                self._look(z)
        except KeyboardInterrupt:
            if not descent.history:
                raise
            descent.watch.interrupted = True
        return np.asarray(descent.best, float) * descent.unit

    def _look(self, z: Any) -> bool:
        """Whether the loss over everything is finite; it is counted then."""
        weights = self.descent.task.all_weights
        total = float(self.descent.losses(z, self.descent.task.data, weights, weights)[1])
        if not np.isfinite(total):
            self.descent.nonfinite += 1
            return False
        self.descent.count(z, total)
        return True


def _rows_of(problem: Problem, size: int) -> int:
    """How many rows the data have, or one ValueError."""
    if problem.residual.priors is not None or problem.stages:
        raise ValueError("minibatch goes without priors and stages; leave these out, or look at all data at once")
    leaves = [np.shape(leaf) for leaf in jax.tree.leaves(problem.data)]
    shapes = [shape for shape in problem.form.shapes if shape is not None]
    counts = {shape[0] if shape else 0 for shape in [*leaves, *shapes]}
    if not leaves or len(counts) != 1 or not 1 <= size <= min(counts):
        raise ValueError(
            f"minibatch must be from 1 to the rows of data, the first axis of all data and of what residual returns, "
            f"got {size} for data {leaves} and residuals {shapes}"
        )
    some = jax.tree.map(lambda a: jax.ShapeDtypeStruct((size, *jnp.shape(a)[1:]), jnp.result_type(a)), problem.data)
    x = jax.ShapeDtypeStruct((problem.layout.size,), problem.layout.dtype)
    (rows,) = counts
    try:
        found = jax.eval_shape(problem.residual, x, some).shape[0]
    except (TypeError, ValueError) as error:
        raise ValueError(f"residual must take {size} rows of the data, for minibatch; it says: {error}") from error
    if found * rows != problem.form.size * size:
        raise ValueError(f"residual must return a row for each row of data, got {found} numbers for {size} rows")
    return rows
