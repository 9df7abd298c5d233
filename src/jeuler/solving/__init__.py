"""Steps in a loop: on a fixed grid of times, of adaptive size, or undone step by step."""

from jeuler.solving._adaptive import AdaptiveSolution, solve_adaptive
from jeuler.solving._ensemble import Ensemble, ensemble
from jeuler.solving._scan import Solution, solve
from jeuler.solving.reducers import Moments, Quantiles

__all__ = [
    "AdaptiveSolution",
    "Ensemble",
    "Moments",
    "Quantiles",
    "Solution",
    "ensemble",
    "solve",
    "solve_adaptive",
]


def __dir__() -> list[str]:
    return __all__
