"""The linear map that one step makes of the linearised equation, as a matrix, and the dt at which it begins to grow."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler.steps.explicit import Step

GROWTH = 1e-9  # a modulus of an eigenvalue of the map above 1 by less than this is roundoff
SLOW = 0.02  # dt |lambda|: growth that begins below it without any decay before is a growth at every dt
SMALL = 64  # numbers in the state up to which the scan is dense and the bisection fine


def matrix_of_step(step: Step, like: Any) -> Callable[[np.ndarray, float], np.ndarray]:
    """``image(matrix, dt)``: the matrix M of one step of size dt on y' = matrix y, column by column.

    like: a state of the form on which the step is to work.
    """
    leaves, structure = jax.tree.flatten(like)
    hashable: Any = step
    return _matrix_of_step(hashable, structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves))


@functools.lru_cache(maxsize=64)
def _matrix_of_step(step: Any, structure: Any, forms: tuple) -> Callable[[np.ndarray, float], np.ndarray]:
    like = jax.tree.unflatten(structure, [jnp.zeros(shape, dtype) for shape, dtype in forms])
    unflatten = trees.real_vector(like)[1]

    def linear(t, y, matrix):
        return unflatten(matrix @ trees.real_vector(y)[0])

    @jax.jit
    def image(matrix, dt):
        def column(u):
            return trees.real_vector(step(linear, jnp.zeros_like(dt), unflatten(u), dt, matrix))[0]

        return jax.vmap(column, out_axes=1)(jnp.eye(len(matrix)))

    return lambda matrix, dt: np.asarray(image(matrix, jnp.asarray(dt, jnp.float64)))


@dataclasses.dataclass
class StepMap:
    """The eigenvalues of a step's matrix M(dt) on y' = J y, without those of what drifts and of what grows by nature.

    Attributes:
      image: M at a dt.
      scale: the largest |lambda| of J.
      neutral: how many eigenvalues of J are zero up to roundoff; as many of M, those nearest to 1, are left out.
      growing: eigenvalues lambda of J whose growth is the solution's own; for each the one of M nearest to
        exp(dt lambda) is left out.
    """

    image: Callable[[float], np.ndarray]
    scale: float
    neutral: int
    growing: np.ndarray
    known: dict[float, float] = dataclasses.field(default_factory=dict)

    def radius(self, dt: float) -> float:
        """The spectral radius of M(dt) less 1; inf where M is not finite."""
        if dt not in self.known:
            matrix = self.image(dt)
            self.known[dt] = self._radius(matrix, dt) if np.all(np.isfinite(matrix)) else math.inf
        return self.known[dt]

    def _radius(self, matrix: np.ndarray, dt: float) -> float:
        found = np.linalg.eigvals(matrix)
        found = found[np.argsort(np.abs(found - 1), kind="stable")[self.neutral :]]
        for rate in self.growing:
            own = np.exp(min(dt * rate.real, 300.0) + 1j * dt * rate.imag)
            if found.size:
                found = np.delete(found, np.abs(found - own).argmin())
        return float(np.abs(found).max(initial=0.0)) - 1

    def limit(self, interval: float = math.inf) -> float:
        """The end of the first dts at which nothing grows e-fold within the interval: 0.0 if none, inf if no end."""

        def unstable(dt):
            return self.radius(dt) > GROWTH + dt / interval

        small = len(self.image(1 / self.scale)) <= SMALL

        def next_to(dt):  # few tries where each is expensive: limits are mostly at dt |lambda| from 0.1 to 3
            return dt * 10 ** (1 / 16 if small else 1 / 8 if 0.05 < dt * self.scale < 8 else 1 / 2)

        dt = 1e-3 / self.scale
        if unstable(dt):
            low, high = dt, dt
            while unstable(low):
                low, high = low / 10 ** (1 / 16 if small else 1 / 8), low
                if low * self.scale < 1e-8:
                    return 0.0
        else:
            while not (unstable(dt) and unstable(1.02 * dt)):  # twice: no noise of a solve
                low, dt = dt, next_to(dt)
                if dt * self.scale > 1e3:
                    return math.inf
            high = dt
        fine = 1e-6 if small else 1e-3
        while high > low * (1 + fine):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if unstable(middle) else (middle, high)
        if math.isinf(interval) and low * self.scale < SLOW and self.radius(low / 4) > -1e-12:
            return 0.0
        return low
