"""Steps: ``step(f, t, y, dt, args) -> y`` advances any pytree y from t to t + dt; and where each is stable."""

from jeuler.steps.explicit import cap_cotangent, euler_step, heun_step, rk4_step, symplectic_euler_step
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import (
    implicit_euler,
    implicit_euler_step,
    linearly_implicit_euler,
    linearly_implicit_euler_step,
)
from jeuler.steps.midpoint import implicit_midpoint_step
from jeuler.steps.stability import StabilityLimit, stability_limit

__all__ = [
    "StabilityLimit",
    "cap_cotangent",
    "euler_step",
    "extrapolated_euler",
    "heun_step",
    "implicit_euler",
    "implicit_euler_step",
    "implicit_midpoint_step",
    "linearly_implicit_euler",
    "linearly_implicit_euler_step",
    "rk4_step",
    "stability_limit",
    "symplectic_euler_step",
]


def __dir__() -> list[str]:
    return __all__
