"""Errors of chosen numbers, one linear problem each: for fits of so many unknowns that all errors would take hours."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core.partition import OfArrays
from jeuler.fitting.least_squares import State, Task
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.many import autocovariances_by_signs, coloured
from jeuler.fitting.problem import FlatResidual, Problem, series_of
from jeuler.fitting.uncertainty import Noise, Series, autoregression

ASKED = "errors when asked for"  # under this name an `Asked` is kept beside a result
PROBES = 8  # random directions that estimate the norms of the columns
MOST_TURNS = 5_000  # of conjugate gradients
LAGS = 2  # of the noise: each takes further linear problems, once
LEFT = 1e-4  # of the right-hand side, at which they end: the variance is then right to about the square of that


def quick_to_compile(residual: FlatResidual) -> FlatResidual:
    """The residual with its steps written in loops, where it has such a form of itself, ``in_loops``."""
    function: Any = residual.residual
    if isinstance(function, OfArrays) and hasattr(function.function, "in_loops"):
        function = dataclasses.replace(function, function=function.function.in_loops())
    elif hasattr(function, "in_loops"):
        function = function.in_loops()
    return dataclasses.replace(residual, residual=function)


@dataclasses.dataclass(frozen=True)
class Asked:
    """What a fit needs to compute one error more: kept beside a result (`jeuler.fitting.beside`)."""

    problem: Problem
    loss: str
    state: State
    task: Task

    def errors(self, direction: np.ndarray) -> tuple[float, float]:
        """The error of the sum of ``direction`` times the unknowns, for correlated noise or white, whichever is larger,
        and for white noise.

            var = c^T A^-1 J^T S J A^-1 c,   A s = c by conjugate gradients

        inf where the data do not determine it, or the turns do not suffice.
        """
        if not direction.any():
            return 0.0, 0.0
        _, change, left = self._solved(direction, np.zeros(len(self.state.residual)), self.loss)
        if not left <= 10 * LEFT:
            return float(np.inf), float(np.inf)
        variance, gamma, noise = self._noise
        series, rows = self._series
        white = correlated = float(np.sum(change**2)) * variance
        if noise is not None:
            own = float(np.sum(coloured(change[:rows, None], noise, series) ** 2))
            own = own / gamma if self._absolute else own
            correlated = max(white, own + float(np.sum(change[rows:] ** 2)))
        return float(np.sqrt(correlated)), float(np.sqrt(white))

    def follows(self, k: int) -> np.ndarray:
        """How far all unknowns go with a unit of the k-th one, when they follow it to the least cost: A s = e_k."""
        s, _, _ = self._solved(np.eye(1, len(self.state.x), k)[0], np.zeros(len(self.state.residual)), self.loss)
        return s / s[k]

    def _solved(self, direction: np.ndarray, z: np.ndarray, loss: str) -> tuple[np.ndarray, np.ndarray, float]:
        """s and J s with A s = c + J^T z, and what is left, relative; A = J^T diag(curvature of the loss) J."""
        program = _solution(self.problem.residual)
        curvature = LOSSES[loss].curvature(self.state.residual / float(self.task.spread))
        s, change, left = program(self.state.x, self.task, curvature, direction, z)
        return np.asarray(s, float), np.asarray(change, float), float(left)

    @property
    def _absolute(self) -> bool:
        return self.problem.absolute and self.loss == "linear"

    @property
    def _series(self) -> tuple[Series, int]:
        """The series of the residual, and how many rows they have: those of priors come after."""
        series, priors = series_of(self.problem.form), self.problem.residual.priors
        if priors is None:
            return series, self.problem.form.size
        return series[:-1], self.problem.form.size - len(priors.places)

    @functools.cached_property
    def _noise(self) -> tuple[float, float, Noise | None]:
        """The variance that counts, that of the noise as seen, and how it is correlated; None where it is white."""
        _, slope = LOSSES[self.loss](self.state.residual / float(self.task.spread))
        residual, n = self.state.residual * slope**2, len(self.state.x)
        counted = np.asarray(self.task.all_weights) > 0
        series, rows = self._series

        def left_over(z: np.ndarray) -> np.ndarray:
            return np.stack([one - self._solved(np.zeros(n), one, "linear")[1] for one in z.T], axis=1)

        gamma = autocovariances_by_signs(
            residual, counted, left_over, series, n, fixed=len(residual) - rows, most_lags=LAGS, least=2
        )
        noise = autoregression(gamma, np.sum(counted), np)
        variance = float(np.sum(residual**2)) / max(int(counted.sum()) - n, 1)
        variance = 1.0 if self._absolute else variance
        return variance, float(gamma[0]), (noise if noise.order > 0 else None)


@functools.lru_cache(maxsize=8)
def _solution(residual: FlatResidual) -> Any:
    """(x, task, curvature, c, z) -> s, J s with A s = c + J^T z, and what is left, relative; kept for later."""
    residual = quick_to_compile(residual)

    @jax.jit
    def solved(x: Array, task: Task, curvature: Array, direction: Array, z: Array) -> tuple[Array, ...]:
        def weighted(x: Array) -> Array:
            return jnp.where(task.all_weights > 0, residual(x, task.data) * task.all_weights, 0)

        r, forwards = jax.linearize(weighted, x)
        backwards = jax.linear_transpose(forwards, x)
        signs = jax.random.rademacher(jax.random.key(0), (PROBES, len(r)), x.dtype)
        norms = jnp.sqrt(jnp.mean(lax.map(lambda row: backwards(row)[0], signs) ** 2, axis=0))
        largest = jnp.max(norms)
        unit = 1 / jnp.where(norms > 1e-6 * largest, norms, jnp.maximum(largest, jnp.finfo(x.dtype).tiny))

        def normal(s: Array) -> Array:
            return unit * backwards(curvature * forwards(unit * s))[0]

        right = unit * (direction + backwards(z)[0])
        size = jnp.linalg.norm(right)
        s, left = _conjugate_gradients(normal, right / size)
        s = unit * s * size
        return s, forwards(s), left

    return solved


def _conjugate_gradients(product: Any, b: Array) -> tuple[Array, Array]:
    """s with A s = b for b of norm one, and the norm of what is left."""

    def goes_on(carry: Any) -> Any:
        _, _, _, square, n = carry
        return (n < MOST_TURNS) & (square > LEFT**2)

    def turn(carry: Any) -> Any:
        s, left, direction, square, n = carry
        image = product(direction)
        bend = jnp.sum(direction * image)
        length = square / bend
        s, left = s + length * direction, left - length * image
        new = jnp.sum(left**2)
        return s, left, left + new / square * direction, new, n + 1

    s, _, _, square, _ = lax.while_loop(goes_on, turn, (jnp.zeros_like(b), b, b, jnp.sum(b**2), 0))
    return s, jnp.sqrt(square)
