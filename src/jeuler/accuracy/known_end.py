"""The state at t1 that errors of advise_step are judged by: of an adaptive run known well enough, if there is one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.precision import cast, double_precision, flat, flat_rows
from jeuler.accuracy.pilot import SAMPLES, distance, norm
from jeuler.solving._adaptive import solve_adaptive
from jeuler.steps.explicit import Step
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import linearly_implicit_euler_step

RTOL = 1e-8, 1e-11, 1e-13  # of adaptive runs; the first that agrees with the one before is the reference
DECAYING, SINKS = 32, 1e-3  # further runs at the last, while the end sinks to less than such a part of it
MOST_STEPS, MOST_STIFF_STEPS = 65_536, 8_192
JUMP = 1e-3  # part of f by which it does not change in a few units in the last place of the time
SMALL, KICK = (
    1e-6,
    1e-6,
)  # parts of a state: an end that may be roundoff alone, and what is added to see what becomes of it
NOTHING, UNKNOWN = 10.0, 1000.0  # times the roundoff of an end that is nothing else: as runs agree on it or do not
STIFF_STEP = extrapolated_euler(6, step=linearly_implicit_euler_step)
STIFF_WORDS = "solve_adaptive with step=extrapolated_euler(6, step=linearly_implicit_euler_step)"


@dataclasses.dataclass(frozen=True)
class Reference:
    """States of an adaptive run that is known well enough, and how to make one like it."""

    times: np.ndarray
    states: np.ndarray
    words: str
    step: Step | None
    roundoff: float = 0.0  # what rounding on the way makes of the end in float64, where that is small beside the way
    vanishes: bool = False  # whether the end is nothing else

    @property
    def final(self) -> np.ndarray:
        return self.states[-1]


def find_reference(
    problem: tuple[Any, ...],
    max_steps: int,
    tolerance: Callable[[np.ndarray | None], float],
    over: Callable[[], bool],
) -> tuple[Reference | None, bool]:
    """An adaptive run, explicit or else linearly implicit, if two tolerances agree to ``tolerance(end)``, or None.

    The states on its way say where the equation is stiff. What decays is known in its own terms: atol sinks with it.
    An end that is 0 but for roundoff is known as soon as runs agree on it in the units of the state.

    Args:
      problem: (f, y0, t0, t1, args, breaks).
      tolerance: of an end; of None, of one that vanishes.
      over: whether no further run is to be begun.
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
            common = {"args": args, "step": step, "max_steps": min(most, max_steps), "breaks": breaks}
            run = lambda start, t0, t1, rtol, size, common=common: solve_adaptive(  # noqa: E731
                f, start, t0=t0, t1=t1, rtol=rtol, atol=rtol * size, **common
            )
            known: Any = None  # the run before
            for count, rtol in enumerate((*RTOL, *DECAYING * RTOL[-1:]), start=1):
                if over():
                    break
                made = run(y0, t0, times, rtol, size)
                finite = bool(np.all(np.isfinite(flat_rows(made.y)[-1])))
                before, known = known, made if finite else known
                if before is None and not finite:
                    break
                if before is not None:
                    old, end = (flat_rows(each.y)[-1] for each in (before, known))
                    change = distance(old, end)
                    agreed, sinks = finite and change <= tolerance(end), finite and norm(end) < SINKS * norm(old)
                    if agreed or (count >= len(RTOL) and not sinks):
                        roundoff = roundoff_of_end(run, known.y, times, size)
                        vanishes = norm(end) <= (NOTHING if agreed else UNKNOWN) * roundoff
                        if agreed or (vanishes and change <= tolerance(None)):
                            states = flat_rows(known.y)[1:]
                            return Reference(times, states, words, step, roundoff, vanishes), disagreeing
                    disagreeing = True
                    if not finite or (count >= len(RTOL) and not sinks):
                        break
                size = min(size, norm(flat_rows(known.y)[-1]) or size)
    return None, disagreeing


def roundoff_of_end(run: Callable[..., Any], y: Any, times: np.ndarray, size: float) -> float:
    """What rounding of the states on the way makes of the end, where that is far smaller than they are; else 0.0.

    Each state is moved by a millionth of its size, and the run gone on with; rounding moves it by eps of its size. The
    runs are made in terms of ``size``, or if they are not finished so, of the state that they begin at.
    """
    rows = flat_rows(y)
    sizes, largest = [norm(row) for row in rows], 0.0
    if not sizes[-1] < SMALL * max(sizes):
        return largest
    for k in range(1, len(times)):
        kick = KICK * sizes[k] / math.sqrt(rows.shape[1])
        starts = [jax.tree.map(lambda leaf, k=k, moved=moved: leaf[k] + moved, y) for moved in (0.0, kick)]
        for unit in (size, sizes[k]):
            a, b = (flat_rows(run(start, times[k - 1], times[-1:], RTOL[1], unit).y)[-1] for start in starts)
            if np.isfinite(change := distance(a, b)):
                largest = max(largest, float(np.finfo(float).eps) * change / KICK)
                break
    return largest


def is_jump(f: Any, y: Any, numbers: Any, args: Any, times: tuple[float, float]) -> bool:
    """Whether f at two neighbouring times differs; at y, or at the state of its form with these numbers."""
    with double_precision():
        start, unflatten = trees.real_vector(cast(y, float))
        state, args = unflatten(start if numbers is None else jnp.asarray(numbers)), cast(args, float)
        a, b = (flat(f(jnp.asarray(t, float), state, args)) for t in times)
        return bool(distance(a, b) > JUMP * max(norm(a), norm(b)))
