"""What a work-precision table is to run: each method with its step sizes and tolerances."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler.accuracy.method import Method
from jeuler.accuracy.runs import AdaptiveRun, FixedRun, fixed_grid


@dataclasses.dataclass(frozen=True)
class Plan:
    """The runs of one method, from coarse to fine."""

    name: str
    method: Method
    fixed: list[FixedRun]
    adaptive: list[AdaptiveRun]

    @property
    def runs(self) -> list[Any]:
        return [*self.fixed, *self.adaptive]


def make_plans(methods: dict[str, Method], dts: Any, tolerances: Any, t0: float, t1: float, points: int) -> list[Plan]:
    """What is to be run, or one ValueError."""
    if all(method.dts is None for method in methods.values()) and not np.size(dts):
        raise ValueError("dts must name at least one step size, got none")
    plans = []
    for name, method in methods.items():
        own = f"steps[{name!r}]."
        sizes = _positive_values("dts", dts, "s") if method.dts is None else _positive_values(f"{own}dts", method.dts)
        if max(sizes, default=0) > 1.5 * (t1 - t0):
            raise ValueError(
                f"each of dts must be below t1 - t0 = {t1 - t0:g} s, got {max(sizes):g} s; take smaller ones"
            )
        pairs = _pairs("tolerances", tolerances)
        if method.tolerances is not None:
            pairs = _pairs(f"{own}tolerances", method.tolerances)
            if pairs and not method.is_adaptive:
                raise ValueError(
                    f"{own}tolerances must be () for a step that does not choose its own dt, got "
                    f"{checks.shown(method.tolerances)}; take extrapolated_euler or an adaptive diffrax solver"
                )
        fixed = {run.num_steps: run for run in (fixed_grid(t0, t1, dt, points) for dt in sorted(sizes, reverse=True))}
        loose_first = sorted(pairs, reverse=True) if method.is_adaptive else []
        plan = Plan(name, method, list(fixed.values()), [AdaptiveRun(*pair) for pair in loose_first])
        if not plan.runs:
            raise ValueError(f"{own}dts or .tolerances must name at least one run, got none")
        plans.append(plan)
    return plans


def _positive_values(name: str, values: Any, unit: str = "") -> list[float]:
    try:
        if isinstance(values, str) or np.ndim(values) > 1:
            raise TypeError
        values = np.atleast_1d(np.asarray(values)).tolist()
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a list of numbers above 0, got {checks.shown(values)}") from None
    for value in values:
        checks.positive(f"each of {name}", value, unit)
    return values


def _pairs(name: str, values: Any) -> list[tuple[float, float]]:
    """Tolerances as pairs (rtol, atol)."""
    expected = f"{name} must be a list of numbers above 0 or of pairs (rtol, atol)"
    if isinstance(values, str) or not np.iterable(values):
        values = [values]
    pairs = []
    for value in values:
        pair = (value, value) if np.ndim(value) == 0 else tuple(value)
        if len(pair) != 2:
            raise ValueError(f"{expected}, got {checks.shown(value)}")
        for what, part in zip(("rtol", "atol"), pair, strict=True):
            checks.number(f"{what} of each of {name}", part)
            if float(part) < 0:
                raise ValueError(f"{expected}, got {what} = {part!r}")
        if not max(map(float, pair)) > 0:
            raise ValueError(f"{expected}, got {checks.shown(value)}")
        pairs.append((float(pair[0]), float(pair[1])))
    return pairs
