"""The part of a record that is not fitted: where a model shows whether it predicts."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.component import replace
from jeuler.fitting.measured.recording import Recording
from jeuler.fitting.series import Columns

WORSE = 1.5  # times the residual of the fitted part: what is worth a word


def rows_held_out(held_out: Any, times: Any) -> np.ndarray:
    """Which times are not fitted, from a share of the span at its end or a mask, or one ValueError."""
    times = np.asarray(times, float)
    if np.ndim(held_out) == 0:
        checks.number("held_out", held_out)
        if not 0 < held_out < 1:
            raise ValueError(
                f"held_out must be a share of the span of the times between 0 and 1, or booleans (time,), "
                f"got {held_out!r}"
            )
        rows = times > times[-1] - float(held_out) * (times[-1] - times[0]) if times.size else np.zeros(0, bool)
    else:
        rows = np.asarray(held_out)
        if rows.dtype != bool or rows.shape != times.shape:
            raise ValueError(
                f"held_out must be booleans (time,) = {times.shape}, or a share between 0 and 1, got "
                f"{rows.dtype}{rows.shape}"
            )
    if rows.all() or not rows.any():
        raise ValueError(f"held_out must leave times to fit and times to judge by, got {rows.sum()} of {rows.size}")
    return rows


def without(held: np.ndarray, values: Any) -> Any:
    """The values with NaN at the times that are held out."""
    xp: Any = jnp if checks.is_traced(values) else np
    values = xp.asarray(values, None if checks.is_traced(values) else float)
    return xp.where(held.reshape(-1, *(1,) * (values.ndim - 1)), xp.nan, values)


def recordings_without(held_out: Any, recordings: list[Recording]) -> tuple[list[Recording], list[np.ndarray]]:
    """The recordings with NaN at the times that are held out, and those times."""
    if np.ndim(held_out) and len(recordings) > 1:
        raise ValueError("held_out must be one share with recordings=..., the last part of each; got an array")
    held = [rows_held_out(held_out, each.times) for each in recordings]
    return [replace(r, values=without(rows, r.values)) for r, rows in zip(recordings, held, strict=True)], held


def judged(shown: list[Columns], held: list[np.ndarray], message: str) -> dict[str, Any]:
    """The residuals of both parts, and a message with a sentence where what was held out is predicted worse."""
    fitted, rest = [], []
    for (_, observed, predicted), rows in zip(shown, held, strict=True):
        fitted.append((predicted - observed)[~rows].ravel())
        rest.append((predicted - observed)[rows].ravel())
    first, second = (_root_mean_square(np.concatenate(part)) for part in (fitted, rest))
    if second > WORSE * first:
        message += (
            f"; the part that was held out is off by {second:.3g}, {second / first if first else np.inf:.2g} times the "
            f"part that was fitted: the model does not predict what it was not shown"
        )
    return {"training_rms": first, "held_out_rms": second, "message": message}


def _root_mean_square(x: np.ndarray) -> float:
    seen = np.isfinite(x)
    return float(np.sqrt(np.mean(x[seen] ** 2))) if seen.any() else float("nan")
