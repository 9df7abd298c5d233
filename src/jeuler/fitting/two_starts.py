"""A search from what the data say and, where that is not good, from the given values."""

from __future__ import annotations

import dataclasses
from typing import Any

from jeuler.fitting.engine import Outcome, run
from jeuler.fitting.options import Known, Options
from jeuler.fitting.problem import Problem
from jeuler.fitting.result import Fit

GOOD = 1.5  # times the noise: a residual below this leaves nothing to look for elsewhere


def from_both(
    given: Problem, begun: Problem | None, options: Options, scale: dict[str, Any], known: Known
) -> tuple[Outcome, str]:
    """Search from the data and, where that is not good, from the given values; the better, and its start."""
    if begun is None:
        return run(given, options, scale=scale, known=known), "given"
    try:
        near = dataclasses.replace(known, near=True)
        best = run(dataclasses.replace(begun, stages=()), options, scale=scale, known=near)
    except ValueError:  # not finite there, as where a sensor's gain is not that of its start
        return run(given, options, scale=scale, known=known), "given"
    if is_good(best.fit) or options.optimizer is not None or best.interrupted:
        return best, "data"
    try:
        other = run(given, dataclasses.replace(options, resume=None), scale=scale, known=known)
    except ValueError:  # not finite at the given values: nothing to set against the other
        return best, "data"
    return (other, "given") if other.fit.loss < best.fit.loss * (1 - 1e-6) else (best, "data")


def is_good(found: Fit) -> bool:
    """Whether the fit leaves nothing to look for from another start."""
    if not found.converged:
        return False
    if found.noise_ratio is not None and found.noise_ratio <= GOOD:
        return True
    return found.explained is not None and found.explained > 0.99
