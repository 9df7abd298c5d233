"""Profile-likelihood intervals: how far one parameter can go when all others follow."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jeuler.fitting.least_squares import Task
    from jeuler.fitting.unknowns import Layout

MOST_TRIES = 20
NEAR = 0.01  # of a standard error
AGAIN = "search again"  # under this name an `Again` is kept beside a result


class Profile(NamedTuple):
    """An interval of one parameter, and the points on its way.

    Attributes:
      name: of the parameter.
      value: the fitted one.
      lower, upper: where the others can no longer make up for it; -inf or inf where they always can, or the bound.
      values: of the parameter, in order, (point,).
      distances: how far each is from the best fit, in standard errors: the signed root of the loss's rise.
      converged: whether both ends are what they are said to be: each search of the others converged, and none found
        a loss below that of the fit.
    """

    name: str
    value: float
    lower: float
    upper: float
    values: np.ndarray
    distances: np.ndarray
    converged: bool


class Ended(NamedTuple):
    """Where a search with one parameter held ended."""

    x: np.ndarray
    cost: float
    converged: bool


@dataclasses.dataclass(frozen=True)
class Again:
    """What a fit needs to search once more with one parameter held: kept beside a result (`jeuler.fitting.beside`).

    Attributes:
      task: of the whole data, with the bounds of all parameters.
      x: the best of the fit.
      search: from a task and a start to where the others end.
      errors: of the k-th parameter, for correlated noise and for white.
      follows: how far the others go with a unit of the k-th one, by the linear model, (n,).
      variance: of the weighted noise.
    """

    layout: Layout
    task: Task
    x: np.ndarray
    search: Callable[[Task, np.ndarray], Ended]
    errors: Callable[[int], tuple[float, float]]
    follows: Callable[[int], np.ndarray]
    variance: float

    @functools.cached_property
    def best(self) -> Ended:
        """The minimum itself, as near as the searches with one parameter held come to theirs."""
        return self.search(self.task, self.x)

    def profile(self, name: str, z: float) -> Profile:
        """The interval out to z standard errors."""
        k = self.layout.place(name, "name")
        value, (error, white) = float(self.best.x[k]), self.errors(k)
        points, told = {value: 0.0}, [True]
        seen = np.isfinite(error) and error > 0
        line = _Line(self, k, z, error, error / white if seen and white > 0 else 1.0, self.follows(k) if seen else None)
        lower, upper = (line.end(side, points, told) for side in (-1, 1))
        values = np.array(sorted(points))
        return Profile(name, value, lower, upper, values, np.array([points[v] for v in values]), all(told))


class _Line(NamedTuple):
    """The way of one parameter."""

    again: Again
    k: int
    z: float
    error: float
    wider: float  # than for white noise
    follows: np.ndarray | None  # None where the data do not determine it

    def end(self, side: int, points: dict[float, float], told: list[bool]) -> float:
        """Where the distance reaches z on one side, by the secant rule: the root of the rise is nearly a line."""
        best, task = float(self.again.best.x[self.k]), self.again.task
        bound = float((task.lower if side < 0 else task.upper)[self.k])
        if self.follows is None:
            return bound if np.isfinite(bound) else side * np.inf
        near, previous, reach = self.again.best.x, (best, 0.0), best + side * self.z * self.error
        for _ in range(MOST_TRIES):
            at = float(max(reach, bound) if side < 0 else min(reach, bound))
            found, distance = self._held(at, near)
            near, points[at] = found.x, side * distance
            if abs(distance - self.z) < NEAR or (at == bound and distance < self.z):
                told.append(found.converged)
                return at
            slope = (distance - previous[1]) / (at - previous[0])
            if not np.isfinite(distance) or slope * side <= 0:
                reach = (at + previous[0]) / 2 if not np.isfinite(distance) else at + (at - best)
            else:
                reach = at + float(np.clip((self.z - distance) / slope, -2 * abs(at - best), 2 * abs(at - best)))
            if np.isfinite(distance):
                previous = (at, distance)
            if abs(reach - best) > 1e6 * self.error:
                return side * np.inf
        told.append(False)
        return reach

    def _held(self, value: float, near: np.ndarray) -> tuple[Ended, float]:
        """The best of the others with the parameter held at a value, and the distance in standard errors."""
        again, hold = self.again, np.arange(len(near)) == self.k
        task = again.task._replace(
            lower=np.where(hold, value, again.task.lower), upper=np.where(hold, value, again.task.upper)
        )
        x = np.clip(near + (value - near[self.k]) * self.follows, task.lower, task.upper)
        found = again.search(task, x)
        rise = (found.cost - again.best.cost) / again.variance
        honest = found.converged and again.best.converged and rise > -NEAR
        return found._replace(converged=honest), float(np.sqrt(max(rise, 0.0))) / self.wider
