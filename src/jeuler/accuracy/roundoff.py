"""How roundoff grows with the number of steps, as a power law through measured differences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

COUNTER = 2**31 - 1  # steps that the integer clock can count


@dataclasses.dataclass(frozen=True)
class Rounding:
    """Roundoff error at the final time after n steps: size n^growth."""

    size: float
    growth: float

    @classmethod
    def fitted(cls, num_steps: Sequence[int], errors: Iterable[float], compensated: bool) -> Rounding:
        """growth between 1/2 (a random walk) and 1 (a drift) in plain sums, 0 in compensated ones."""
        n, error = np.array(num_steps, float), np.array([*errors])
        able = np.isfinite(error) & (error > 0)
        n, error = n[able], error[able]
        if not able.any():
            return cls(float(np.finfo(float).eps), 0.5)
        if compensated:
            return cls(float(error.max()), 0.0)
        slope = np.polyfit(np.log(n), np.log(error), 1)[0] if len(n) > 1 else 0.5
        growth = float(np.clip(slope, 0.5, 1.0))
        return cls(float(np.exp(np.mean(np.log(error) - growth * np.log(n)))), growth)

    def after(self, num_steps: Any) -> Any:
        return self.size * num_steps**self.growth

    def floor(self, truncation: float, order: int) -> tuple[float, int]:
        """The least of truncation / n^order + roundoff(n) over the numbers of steps n that the clock can count,
        and that n."""
        n = np.geomspace(1, COUNTER, 1401)
        total = truncation / n**order + self.after(n)
        return float(total.min()), int(n[total.argmin()])
