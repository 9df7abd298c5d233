"""Figures and animations; the only room that imports matplotlib."""

from jeuler.plotting.fit import plot_fit

__all__ = ["plot_fit"]
