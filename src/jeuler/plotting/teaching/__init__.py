"""Figures that explain step-by-step integration: fields and curves, errors, stability."""

from jeuler.plotting.teaching.curves import euler_polygon, slope_field, step_sizes
from jeuler.plotting.teaching.errors import error_against_dt, local_and_cumulative_error
from jeuler.plotting.teaching.geometry import neighbouring_curves, tangent_step
from jeuler.plotting.teaching.regions import stability_regions

__all__ = [
    "error_against_dt",
    "euler_polygon",
    "local_and_cumulative_error",
    "neighbouring_curves",
    "slope_field",
    "stability_regions",
    "step_sizes",
    "tangent_step",
]
