"""How the clock of a recording runs: its rate, gaps, repeated stamps, jitter, and where it starts again."""

from __future__ import annotations

import dataclasses

import numpy as np

from jeuler.fitting.recordings.table import counted

LEAST_ROWS = 5
MOST_RUNS = 200


@dataclasses.dataclass(frozen=True)
class Sampling:
    """The clock in numbers: rows, first and last time, s; the median step, s; the spread of the steps as a share of
    it; gaps (steps longer than 3 medians) and the longest; how many stamps repeat the one before."""

    rows: int
    first: float
    last: float
    step: float
    jitter: float
    gaps: int
    longest_gap: float
    repeated: int

    @property
    def span(self) -> float:
        """From the first to the last time, s."""
        return self.last - self.first

    @property
    def rate(self) -> float:
        """Samples a second, Hz."""
        return 1 / self.step if self.step > 0 else float("nan")

    def words(self) -> str:
        """In one line."""
        parts = [f"{self.rows} rows", f"{self.first:.6g} to {self.last:.6g} s", f"{self.rate:.4g} samples a second"]
        if self.jitter > 0.02:
            parts.append(f"steps uneven by {100 * self.jitter:.2g} %")
        if self.gaps:
            parts.append(f"{counted(self.gaps, 'gap')}, the longest {self.longest_gap:.3g} s")
        if self.repeated:
            parts.append(counted(self.repeated, "repeated time stamp"))
        return ", ".join(parts)


def sampling(times: np.ndarray) -> Sampling:
    """The clock of times that do not decrease."""
    steps = np.diff(times)
    moving = steps[steps > 0]
    step = float(np.median(moving)) if len(moving) else 0.0
    long = moving > 3 * step * (1 + 1e-9)
    regular = moving[~long]
    # the spread by quartiles, as rounding of the stamps and a few late samples are no jitter
    jitter = float(np.subtract(*np.percentile(regular, [90, 10])) / step) if len(regular) else 0.0
    return Sampling(
        rows=len(times),
        first=float(times[0]),
        last=float(times[-1]),
        step=step,
        jitter=jitter,
        gaps=int(long.sum()),
        longest_gap=float(moving[long].max()) if long.any() else 0.0,
        repeated=int((steps == 0).sum()),
    )


def restarts(times: np.ndarray) -> list[int] | None:
    """The rows at which the clock starts again near its beginning; None where the times go back otherwise."""
    back = np.flatnonzero(np.diff(times) < 0) + 1
    if not len(back):
        return []
    if len(back) > MOST_RUNS:
        return None
    bounds = [0, *back.tolist(), len(times)]
    for begin, row, end in zip(bounds[:-2], bounds[1:-1], bounds[2:], strict=True):
        before = times[begin:row]
        if min(len(before), end - row) < LEAST_ROWS or times[row] > before[0] + 0.1 * (before[-1] - before[0]):
            return None
    return back.tolist()
