"""Explicit Runge-Kutta steps with an estimate of their error, for `solve_adaptive`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from jeuler._core import trees
from jeuler.steps.explicit import VectorField

PyTree = Any


@dataclasses.dataclass(frozen=True)
class EmbeddedStep:
    """A pair of Runge-Kutta methods on the same stages; the last stage is the slope at the end of the step.

    Attributes:
      order: of the estimated error, dt^order.
      nodes: times of the stages after the first, as parts of dt.
      matrix: one row of weights a stage after the first.
      weights: of the slopes in the increment.
      error_weights: of the slopes in the estimated error.
      allowed: the part of a tolerance that the estimated error of a step may take, as errors of the steps add up.
    """

    order: int
    nodes: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]
    error_weights: tuple[float, ...]
    allowed: float = 0.1

    def increment_with_error(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> tuple[PyTree, PyTree]:
        """y(t + dt) - y, and the estimated error of it."""
        slopes = [f(t, y, args)]
        for node, row in zip(self.nodes, self.matrix, strict=True):
            slopes.append(f(t + node * dt, trees.add(y, trees.scale(dt, trees.combine(row, slopes))), args))
        return (
            trees.scale(dt, trees.combine(self.weights, slopes)),
            trees.scale(dt, trees.combine(self.error_weights, slopes)),
        )


@functools.cache
def tsit5() -> EmbeddedStep:
    """The method of Tsitouras of order 5, with the coefficients that diffrax has.

    Source: C. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption,
      Comput. Math. Appl. 62, 2011.
    """
    import diffrax

    tableau = diffrax.Tsit5.tableau
    rows = tuple(tuple(map(float, row)) for row in tableau.a_lower)
    nodes, weights, error_weights = (tuple(map(float, part)) for part in (tableau.c, tableau.b_sol, tableau.b_error))
    return EmbeddedStep(5, nodes, rows, weights, error_weights)
