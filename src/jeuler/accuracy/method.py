"""What may stand in a work-precision table: a step or a diffrax solver, with options of its own."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterable, Mapping
from typing import Any

from jeuler._core import checks
from jeuler._core.component import result
from jeuler.steps.explicit import Step
from jeuler.steps.extrapolated import ExtrapolatedStep

OPTIONS = ("breaks", "checkpoint", "dt0", "max_steps")
DIFFRAX_OPTIONS = ("adjoint", "controller", "dt0", "max_steps")


@result
class Compensated:
    """A step to be summed with compensation; in the ``steps`` of `work_precision` only.

    Args:
      step: an explicit step.
    Raises: ValueError, in `work_precision`, if the step has no increment.
    Example:
      >>> import jeuler
      >>> jeuler.Compensated(jeuler.euler_step).step is jeuler.euler_step
      True

    Source: A. Neumaier, Rundungsfehleranalyse einiger Verfahren zur Summation endlicher Summen, 1974.
    """

    step: Step


@result
class Method:
    """A step or a diffrax solver with options of its own; in the ``steps`` of `work_precision` only.

    Args:
      step: a step, or a diffrax solver.
      dts: its own step sizes, s; None takes those of the table, () no run of equal steps.
      tolerances: its own tolerances, numbers or pairs (rtol, atol); None takes those of the table, () none.
      compensated: sum with compensation; explicit steps only.
      options: further arguments of the runs. Of a step: ``breaks``, and ``checkpoint`` for its gradient, as `solve`
        takes them; ``dt0``, ``max_steps`` as `solve_adaptive`. Of a diffrax solver, for its runs by tolerance:
        ``controller``, a function ``(rtol, atol) -> step size controller``, ``dt0``, ``max_steps``; and ``adjoint``
        for its gradient.
    Raises: ValueError, in `work_precision`, for an option that there is not.
    Example:
      >>> import jeuler
      >>> table = jeuler.work_precision(
      ...     lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1], reference=lambda t: 2.718281828459045**-t, repeats=1,
      ...     steps={"Euler": jeuler.euler_step, "RK4": jeuler.Method(jeuler.rk4_step, dts=[0.5, 0.25])})
      >>> [(row["method"], row["dt"]) for row in table.rows]
      [('Euler', 0.1), ('RK4', 0.5), ('RK4', 0.25)]
    """

    step: Any
    dts: Any = None
    tolerances: Any = None
    compensated: bool = False
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def is_adaptive(self) -> bool:
        """Whether it can choose its own steps from a tolerance."""
        if isinstance(self.step, ExtrapolatedStep):
            return self.step.order > 1
        if is_diffrax(self.step):
            import diffrax

            return isinstance(self.step, diffrax.AbstractAdaptiveSolver)
        return False

    @property
    def iterates(self) -> bool:
        """Whether one of its steps may take another number of evaluations than the next."""
        if is_diffrax(self.step):
            import diffrax

            return isinstance(self.step, diffrax.AbstractImplicitSolver)
        base = self.step.base if isinstance(self.step, ExtrapolatedStep) else self.step
        return not getattr(base, "explicit", False)


def has_diffrax() -> bool:
    """Whether diffrax is installed."""
    return importlib.util.find_spec("diffrax") is not None


def is_diffrax(step: Any) -> bool:
    """Whether it is a solver of diffrax."""
    if not has_diffrax():
        return False
    import diffrax

    return isinstance(step, diffrax.AbstractSolver)


def named(steps: Any) -> dict[str, Method]:
    """``steps`` as a dictionary of methods: a mapping as it is, a sequence by the names of its functions."""
    if isinstance(steps, Mapping):
        methods = dict(steps)
    else:
        if isinstance(steps, str) or not (_is_one(steps) or isinstance(steps, Iterable)):
            raise ValueError(f"steps must be a list of steps or a dict {{name: step}}, got {steps!r}")
        steps = [steps] if _is_one(steps) else list(steps)
        methods = {_name(step): step for step in steps}
        if len(methods) < len(steps):
            raise ValueError("steps given as a list must have different names; pass a dict {name: step}")
    if not methods:
        raise ValueError("steps must name at least one method, got none")
    return {name: _checked(name, method) for name, method in methods.items()}


def _is_one(x: Any) -> bool:
    return callable(x) or is_diffrax(x) or isinstance(x, (Compensated, Method))


def _name(method: Any) -> str:
    step = getattr(method, "step", method) if isinstance(method, (Compensated, Method)) else method
    return getattr(step, "__name__", type(step).__name__).removesuffix("_step")


def _checked(name: Any, method: Any) -> Method:
    place = f"steps[{name!r}]"
    if not isinstance(name, str):
        raise ValueError(f"steps must be named by strings, got {name!r}")
    if isinstance(method, Compensated):
        method = Method(method.step, compensated=True)
    elif not isinstance(method, Method):
        method = Method(method)
    if not (callable(method.step) or is_diffrax(method.step)):
        raise ValueError(
            f"{place} must be a step (f, t, y, dt, args) -> y, a diffrax solver, or a Method of one, "
            f"got {checks.shown(method.step)}"
        )
    if method.compensated and not hasattr(method.step, "increment"):
        raise ValueError(
            f"{place} must be an explicit step with an .increment for compensated sums, got {_name(method)}"
        )
    known = DIFFRAX_OPTIONS if is_diffrax(method.step) else OPTIONS
    if not isinstance(method.options, Mapping) or set(method.options) - set(known):
        raise ValueError(f"{place}.options must be a dict of {', '.join(known)}, got {checks.shown(method.options)}")
    return method
