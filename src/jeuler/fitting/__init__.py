"""Fitting: parameters of a simulation from what was measured, by gradient."""

from jeuler.fitting.fit import Fit, fit
from jeuler.fitting.springs import SpringFit, fit_springs

__all__ = ["Fit", "SpringFit", "fit", "fit_springs"]
