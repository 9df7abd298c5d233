"""Figures and animations; imports matplotlib, so it is itself imported only where something is drawn."""

from jeuler.plotting.accuracy import plot_work_precision
from jeuler.plotting.camera import Camera
from jeuler.plotting.film import animate
from jeuler.plotting.fits import plot_fit
from jeuler.plotting.hair import Hair
from jeuler.plotting.render import Look, draw
from jeuler.plotting.residuals import plot_correlation, plot_history, plot_net, plot_residual
from jeuler.plotting.studio import still
from jeuler.plotting.teaching import (
    error_against_dt,
    euler_polygon,
    local_and_cumulative_error,
    neighbouring_curves,
    slope_field,
    stability_regions,
    step_sizes,
    tangent_step,
)
from jeuler.plotting.turnable import view

__all__ = [
    "Camera",
    "Hair",
    "Look",
    "animate",
    "draw",
    "error_against_dt",
    "euler_polygon",
    "local_and_cumulative_error",
    "neighbouring_curves",
    "plot_correlation",
    "plot_fit",
    "plot_history",
    "plot_net",
    "plot_residual",
    "plot_work_precision",
    "slope_field",
    "stability_regions",
    "step_sizes",
    "still",
    "tangent_step",
    "view",
]


def __dir__() -> list[str]:
    return __all__
