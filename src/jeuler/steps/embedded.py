"""Explicit Runge-Kutta steps with an estimate of their error, for `solve_adaptive`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from jeuler._core import trees
from jeuler.steps.explicit import VectorField

PyTree = Any


@dataclasses.dataclass(frozen=True)
class EmbeddedStep:
    """A pair of Runge-Kutta methods on the same stages, of which one is the slope at the end of the step.

    Attributes:
      order: of the estimated error, dt^order.
      nodes: times of the stages after the first, as parts of dt.
      matrix: one row of weights a stage after the first.
      weights: of the slopes in the increment; the last of them is that at the end of the step.
      error_weights: of the slopes in the estimated error.
      allowed: the part of a tolerance that the estimated error of a step may take, as errors of the steps add up.
    """

    order: int
    nodes: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]
    error_weights: tuple[float, ...]
    allowed: float = 0.1

    @property
    def gap(self) -> float:
        """The longest part of a step between two looks at f."""
        return float(np.max(np.diff(np.unique([0.0, *self.nodes, 1.0]))))

    def start(self, f: VectorField, t: Any, y: PyTree, args: Any) -> PyTree:
        """What the first step takes over: the slope."""
        return trees.in_dtypes_of(y, f(t, y, args))

    def attempt(
        self, f: VectorField, t: Any, y: PyTree, slope: PyTree, dt: Any, args: Any
    ) -> tuple[PyTree, PyTree, PyTree]:
        """y(t + dt) - y, the estimated error of it, and the slope at its end, which the next step takes over."""
        slopes = [slope]
        for node, row in zip(self.nodes, self.matrix, strict=True):
            stage = trees.add(y, trees.scale(dt, trees.combine(row, slopes[: len(row)])))
            slopes.append(trees.in_dtypes_of(y, f(t + node * dt, stage, args)))
        stages = slopes[: len(self.weights)]
        return (
            trees.scale(dt, trees.combine(self.weights, stages)),
            trees.scale(dt, trees.combine(self.error_weights, slopes)),
            stages[-1],
        )


@functools.cache
def tsit5() -> EmbeddedStep:
    """The method of Tsitouras of order 5, with the coefficients that diffrax has, and one more stage for the error.

    Its stages leave the time from 0.33 to 0.9 dt unseen. So f is evaluated at 0.6 dt too, on the interpolant, and a
    part of its difference from the slope of the interpolant, O(dt^4) where f is smooth, counts as error.

    Source: C. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption,
      Comput. Math. Appl. 62, 2011.
    """
    import diffrax

    tableau = diffrax.Tsit5.tableau
    rows = tuple(tuple(map(float, row)) for row in tableau.a_lower)
    nodes, weights, error_weights = (tuple(map(float, part)) for part in (tableau.c, tableau.b_sol, tableau.b_error))
    between = tuple(float(part(PROBE)) for part in interpolant())
    slope = tuple(float(part.deriv()(PROBE)) for part in interpolant())
    error_weights = *(e - PROBED * s for e, s in zip(error_weights, slope, strict=True)), PROBED
    return EmbeddedStep(5, (*nodes, PROBE), (*rows, between), weights, error_weights)


PROBE = 0.6  # dt: where f is evaluated once more
PROBED = 0.02  # the weight of what it is there beside the slope of the interpolant: little where f is smooth


def interpolant() -> list[Polynomial]:
    """Weights of the slopes in y(t + theta dt) - y(t), over dt, as polynomials in theta.

    Source: Tsitouras, as for `tsit5`.
    """
    x = Polynomial([0.0, 1.0])
    first = (x - 1.3299890189751412) * (x**2 - 1.4364028541716351 * x + 0.7139816917074209)
    return [
        -1.0530884977290216 * x * first,
        0.1017 * x**2 * (x**2 - 2.1966568338249754 * x + 1.2949852507374631),
        2.4906272856512528 * x**2 * (x**2 - 2.3853564547206166 * x + 1.5780346820809249),
        -16.548102889244902 * x**2 * (x - 1.2171292729553324) * (x - 0.616204060378000889),
        47.37952196281928 * x**2 * (x - 1.2030712083723626) * (x - 0.65804729265354738),
        -34.87065786149661 * x**2 * (x - 1.2) * (x - 2 / 3),
        2.5 * x**2 * (x - 1) * (x - 0.6),
    ]
