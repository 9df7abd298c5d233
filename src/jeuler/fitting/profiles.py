"""Profile-likelihood intervals: how far one parameter can go when all others follow."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import State, Task
from jeuler.fitting.losses import Loss

if TYPE_CHECKING:
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
    """

    name: str
    value: float
    lower: float
    upper: float
    values: np.ndarray
    distances: np.ndarray


@dataclasses.dataclass(frozen=True)
class Again:
    """What a fit needs to search once more with one parameter held: kept beside a result (`jeuler.fitting.beside`)."""

    layout: Layout
    evaluate: Evaluate
    loss: Loss
    task: Task
    state: State
    error: np.ndarray
    white: np.ndarray
    variance: float

    def profile(self, name: str, z: float) -> Profile:
        """The interval out to z standard errors."""
        from jeuler.fitting.unknowns import readable

        names, plain = self.layout.names(readable), self.layout.names()
        if name not in names and name not in plain:
            raise ValueError(f"name must be one of {', '.join(names[:8])}{' ...' * (len(names) > 8)}, got {name!r}")
        k = names.index(name) if name in names else plain.index(name)
        points = {float(self.state.x[k]): 0.0}
        lower, upper = (self._end(k, side, z, points) for side in (-1, 1))
        values = np.array(sorted(points))
        return Profile(name, float(self.state.x[k]), lower, upper, values, np.array([points[v] for v in values]))

    def _end(self, k: int, side: int, z: float, points: dict[float, float]) -> float:
        """Where the distance reaches z on one side, by the secant rule: the root of the rise is nearly a line."""
        best, error = float(self.state.x[k]), float(self.error[k])
        bound = float((self.task.lower if side < 0 else self.task.upper)[k])
        if not np.isfinite(error) or error <= 0:
            return bound if np.isfinite(bound) else side * np.inf
        state, previous, reach = self.state, (best, 0.0), best + side * z * error
        for _ in range(MOST_TRIES):
            at = max(reach, bound) if side < 0 else min(reach, bound)
            state, distance = self._held(k, at, state)
            points[at] = side * distance
            if abs(distance - z) < NEAR:
                return at
            if at == bound and distance < z:
                return bound
            slope = (distance - previous[1]) / (at - previous[0])
            if not np.isfinite(distance) or slope * side <= 0:
                reach = (at + previous[0]) / 2 if not np.isfinite(distance) else at + (at - best)
            else:
                reach = at + float(np.clip((z - distance) / slope, -2 * abs(at - best), 2 * abs(at - best)))
            if np.isfinite(distance):
                previous = (at, distance)
            if abs(reach - best) > 1e6 * error:
                return side * np.inf
        return reach

    def _held(self, k: int, value: float, near: State) -> tuple[State, float]:
        """The best of the others with one parameter held at a value, and the distance in standard errors."""
        hold = np.arange(len(near.x)) == k
        task = self.task._replace(
            lower=np.where(hold, value, self.task.lower), upper=np.where(hold, value, self.task.upper)
        )
        x = np.where(hold, value, near.x)
        with np.errstate(all="ignore"):
            fresh = least_squares.start(x, len(near.residual), 200)
            state = least_squares.advance(self.evaluate, self.loss, fresh, task, 1_000_000)
        rise = max(float(state.cost - self.state.cost), 0.0)
        wider = float(self.error[k] / self.white[k]) if self.white[k] > 0 else 1.0
        return state, float(np.sqrt(rise / self.variance)) / wider
