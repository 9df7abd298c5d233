"""What was measured beside what was predicted, as columns over time: what pages and figures show of a fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

Columns = tuple[np.ndarray, np.ndarray, np.ndarray]  # times, measured, predicted


@dataclasses.dataclass(frozen=True)
class Series:
    """Columns over time.

    Attributes:
      times: (time,), s; of several recordings one after another, with a row of NaN between them.
      recordings: which of the fit's recordings these are, from 0.
      observed, predicted: (time, column); NaN = not observed.
      names: of the columns.  quantity, unit: of what they show.
      steps: of the simulation, for each recording.
    """

    times: np.ndarray
    observed: np.ndarray
    predicted: np.ndarray
    names: list[str]
    quantity: str
    unit: str
    steps: list[int]
    recordings: tuple[int, ...] = (0,)

    @property
    def count(self) -> int:
        """How many numbers were measured."""
        return int(np.isfinite(self.observed - self.predicted).sum())

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(np.nanmean((self.observed - self.predicted) ** 2)))


def one_after_another(
    parts: Sequence[Columns],
) -> Columns:
    """Times, observed and predicted of recordings as one record: each begins a gap after the end of the one before."""
    times, observed, predicted = [], [], []
    width, end = max(y.shape[1] for _, y, _ in parts), 0.0
    for k, (t, y, shown) in enumerate(parts):
        gap = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
        begin = end + gap if k else float(t[0])
        if k:
            times.append([end + gap / 2])
            observed.append(np.full((1, width), np.nan))
            predicted.append(np.full((1, width), np.nan))
        filler = np.full((len(t), width - y.shape[1]), np.nan)
        times.append(t - t[0] + begin)
        observed.append(np.concatenate([y, filler], axis=1))
        predicted.append(np.concatenate([shown, filler], axis=1))
        end = float(times[-1][-1])
    return np.concatenate(times), np.concatenate(observed), np.concatenate(predicted)


def column_names(quantity: str, shape: tuple[int, ...], particles: Any) -> list[str]:
    """Names of the numbers of one reading: x0, y0, ... of positions, "velocity 3 x" and the like of others."""
    if len(shape) == 2 and shape[1] <= 3 and quantity in ("position", "velocity", "acceleration"):
        who = range(shape[0]) if particles is None else particles
        before = "" if quantity == "position" else quantity[0]
        return [f"{before}{'xyz'[d]}{k}" for k in who for d in range(shape[1])]
    if not shape:
        return [quantity]
    return [f"{quantity} {', '.join(map(str, k))}" for k in np.ndindex(*shape)]
