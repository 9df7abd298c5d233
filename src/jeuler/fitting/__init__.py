"""Fitting: parameters of a simulation from what was measured, by gradient."""

from jeuler.fitting._comparison import Comparison, compare_fits
from jeuler.fitting._find_springs import FoundSprings, find_springs
from jeuler.fitting._fit import fit
from jeuler.fitting._identifiability import Identifiability, identifiability
from jeuler.fitting._multiple_shooting import ShootingFit, multiple_shooting
from jeuler.fitting._springs import SpringFit, fit_springs
from jeuler.fitting.measured.recording import Recording
from jeuler.fitting.result import Fit
from jeuler.fitting.trajectory import Trajectory, read_trajectory

__all__ = [
    "Comparison",
    "Fit",
    "FoundSprings",
    "Identifiability",
    "Recording",
    "ShootingFit",
    "SpringFit",
    "Trajectory",
    "compare_fits",
    "find_springs",
    "fit",
    "fit_springs",
    "identifiability",
    "multiple_shooting",
    "read_trajectory",
]


def __dir__() -> list[str]:
    return __all__
