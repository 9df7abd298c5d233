"""Solutions as tables for a notebook: the span, the steps, and what it could not do."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jeuler._core.describe import object_table, summary, table


def solution_table(solution: Any) -> str:
    """A `Solution`: from when to when, what was saved, and where it stopped being finite."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(solution)):
        return object_table(solution)
    rows = [("time", span(solution.t)), ("saved", saved(solution.t)), ("y", summary(solution.y))]
    return table("Solution", [*rows, ("finite", nonfinite_in_words(solution.first_nonfinite)), *losses(solution)])


def adaptive_table(solution: Any) -> str:
    """An `AdaptiveSolution`: from when to when, its steps, and whether it reached the end."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(solution)):
        return object_table(solution)
    accepted, rejected, finished = (np.asarray(getattr(solution, n)) for n in ("num_steps", "num_rejected", "finished"))
    steps = f"{accepted.sum()} accepted, {rejected.sum()} rejected"
    end = "yes" if finished.all() else f"no: {np.count_nonzero(~finished)} of {finished.size} runs used max_steps"
    rows = [("time", span(solution.t)), ("saved", saved(solution.t)), ("y", summary(solution.y))]
    gap = f"{np.max(np.asarray(solution.longest_gap)):.3g} s"
    return table("AdaptiveSolution", [*rows, ("steps", steps), ("finished", end), ("longest gap", gap)])


def span(t: Any) -> str:
    t = np.asarray(t)
    return f"{t.min():.6g} to {t.max():.6g} s" if t.size else "empty"


def saved(t: Any) -> str:
    *members, times = np.shape(t) or (1,)
    return f"{times} states" + (f" of each of {np.prod(members, dtype=int)} runs" if members else "")


def nonfinite_in_words(first_nonfinite: Any) -> str:
    """Which steps are finite: every one, or the first that is not, of one run or of a batch."""
    steps = np.asarray(first_nonfinite)
    lost = steps[steps >= 0]
    if not lost.size:
        return "every step"
    first = f"the first step that is not finite is {lost.min()}"
    return first if steps.ndim == 0 else f"{lost.size} of {steps.size} runs are not finite to the end; {first}"


def losses(solution: Any) -> list[tuple[str, str]]:
    """What the run could not do, by name: births without a free slot, contacts that it did not resolve."""
    rows = []
    for holder, name in ((solution.y, "missed_births"), (solution, "unresolved_contacts")):
        value = getattr(holder, name, None)
        if value is not None and hasattr(value, "shape"):
            rows.append((name.replace("_", " "), str(int(np.max(np.asarray(value), initial=0)))))
    return rows
