"""The state at t1 that errors of advise_step are judged by: of an adaptive run known well enough, if there is one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jeuler._core.precision import cast, double_precision, flat, flat_rows
from jeuler.accuracy.pilot import SAMPLES, distance, norm
from jeuler.solving._adaptive import solve_adaptive
from jeuler.steps.explicit import Step
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import linearly_implicit_euler_step

RTOL = 1e-8, 1e-11, 1e-13  # of adaptive runs; the first that agrees with the one before is the reference
DECAYING, SINKS = 32, 1e-3  # further runs at the last, while the end sinks to less than such a part of it
MOST_STEPS, MOST_STIFF_STEPS = 65_536, 8_192
STIFF_STEP = extrapolated_euler(6, step=linearly_implicit_euler_step)
STIFF_WORDS = "solve_adaptive with step=extrapolated_euler(6, step=linearly_implicit_euler_step)"


@dataclasses.dataclass(frozen=True)
class Reference:
    """States of an adaptive run that is known well enough, and how to make one like it."""

    times: np.ndarray
    states: np.ndarray
    words: str
    step: Step | None

    @property
    def final(self) -> np.ndarray:
        return self.states[-1]


def find_reference(
    problem: tuple[Any, ...], max_steps: int, tolerance: Callable[[np.ndarray], float]
) -> tuple[Reference | None, bool]:
    """An adaptive run, explicit or else linearly implicit, if two tolerances agree to ``tolerance(end)``, or None.

    The states on its way say where the equation is stiff. What decays is known in its own terms: atol sinks with it.

    Args:
      problem: (f, y0, t0, t1, args, breaks).
    Returns: the run, and whether some came to different ends.
    """
    f, y0, t0, t1, args, breaks = problem
    times, disagreeing = t0 + (t1 - t0) * np.arange(1, SAMPLES + 1) / SAMPLES, False
    with double_precision():
        y0, args = cast(y0, np.float64), cast(args, np.float64)
        size = max(norm(flat(y0)), 1e-3)
        for step, most, words in (
            (None, MOST_STEPS, "solve_adaptive"),
            (STIFF_STEP, MOST_STIFF_STEPS, STIFF_WORDS),
        ):
            before = None
            for count, rtol in enumerate((*RTOL, *DECAYING * RTOL[-1:]), start=1):
                run = solve_adaptive(
                    f,
                    y0,
                    t0=t0,
                    t1=times,
                    args=args,
                    step=step,
                    rtol=rtol,
                    atol=rtol * size,
                    max_steps=min(most, max_steps),
                    breaks=breaks,
                )
                states = flat_rows(run.y)[1:]
                if not np.all(np.isfinite(states[-1])):
                    break
                if before is not None:
                    if distance(before, states[-1]) <= tolerance(states[-1]):
                        return Reference(times, states, words, step), disagreeing
                    disagreeing = True
                    if count >= len(RTOL) and not norm(states[-1]) < SINKS * norm(before):
                        break
                before = states[-1]
                size = min(size, norm(before) or size)
    return None, disagreeing
