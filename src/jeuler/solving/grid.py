"""The grid of times of a run: its clock, what it saves, and how much of it reverse mode keeps."""

from __future__ import annotations

import functools
import math
import warnings
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.component import component
from jeuler._core.precision import setting

Checkpoint = int | Literal["sqrt", "reversible"] | None


@component(static=("num_steps", "save_every", "segment"))
class Grid:
    """When a run steps and saves: checked, and in the precision of the state."""

    dt: Array
    num_steps: int
    t0: Array
    save_every: int
    segment: int | None

    @classmethod
    def checked(
        cls, dt: Any, num_steps: Any, t0: Any, save_every: Any, checkpoint: Checkpoint, dtype: Any, many: bool = False
    ) -> Grid:
        """The grid of these arguments, or one ValueError that says which is wrong.

        ``many``: whether the run can have more steps than an int32 counts, wherever it is.
        """
        num_steps = checks.count("num_steps", num_steps)
        save_every = checks.count("save_every", save_every, least=1)
        check_counter(num_steps, save_every, many)
        if num_steps % save_every:
            raise ValueError(
                f"save_every must divide num_steps, got save_every={save_every} and num_steps={num_steps}; "
                f"take num_steps={math.ceil(num_steps / save_every) * save_every} or another save_every"
            )
        check_time_step(dt, t0, dtype)
        segment = _segment_length(checkpoint, num_steps)
        dt, t0 = (jnp.asarray(x, dtype) if checks.is_traced(x) else np.asarray(x).astype(dtype) for x in (dt, t0))
        return cls(dt, num_steps, t0, save_every, segment)

    def clock(self, n: Array) -> Array:
        """t0 + n dt."""
        return self.t0 + n.astype(self.dt.dtype) * self.dt


COUNTER = 2**31 - 1  # the most steps that an int32 counts


def check_counter(num_steps: int, save_every: int, many: bool = False) -> None:
    """One ValueError if the run has more steps than its counter can count, which would turn time negative."""
    if num_steps <= COUNTER:
        return
    if not many and not setting("jax_enable_x64"):
        raise ValueError(
            f"num_steps must be at most {COUNTER:,} under jit, vmap and grad where integers have 32 bits, got "
            f"{num_steps:,}; call it outside of these, or turn on 64-bit numbers"
        )
    if max(save_every, num_steps // save_every) > COUNTER:
        raise ValueError(
            f"save_every must be such that neither it nor num_steps / save_every is above {COUNTER:,}, "
            f"got {save_every:,} of {num_steps:,} steps; take save_every={2**20:,}"
        )


def check_time_step(dt: Any, t0: Any, dtype: Any) -> None:
    """One ValueError if dt is 0, as it is or in the precision of the state; a warning where it does not move the clock.

    A negative dt steps back in time.
    """
    checks.number("dt", dt)
    checks.number("t0", t0)
    if checks.is_traced(dt):
        return
    if not float(dt):
        raise ValueError("dt must not be 0 s: the run would stand still; negative steps back in time")
    tiny, largest = _range(dtype)
    if not tiny <= abs(float(dt)) <= largest:
        raise ValueError(
            f"dt must be from {tiny:.2g} to {largest:.2g} s in {jnp.dtype(dtype).name}, the precision of the state, "
            f"got {float(dt):g}; take another unit of time, or a state in float64"
        )
    if checks.is_traced(t0):
        return
    if not abs(float(t0)) <= largest:
        raise ValueError(f"t0 must be below {largest:.2g} s in {jnp.dtype(dtype).name}, got {float(t0):g}")
    start = np.asarray(t0, dtype)
    if start + np.asarray(dt, dtype) == start:
        warnings.warn(
            f"dt={float(dt):g} s does not move the clock from t0={float(t0):g} s in {start.dtype}, the precision of "
            f"the state: what depends on t sees it stand still; count t from a nearer t0, or take a state in float64",
            stacklevel=4,
        )


@functools.lru_cache(maxsize=16)
def _range(dtype: Any) -> tuple[float, float]:
    """The least and the largest normal number."""
    return float(jnp.finfo(dtype).tiny), float(jnp.finfo(dtype).max)


def _segment_length(checkpoint: Checkpoint, num_steps: int) -> int | None:
    if checkpoint is None or checkpoint == "reversible":
        return None
    if checkpoint == "sqrt":
        return max(1, math.isqrt(num_steps))
    if isinstance(checkpoint, str):
        raise ValueError(f'checkpoint must be None, "sqrt", "reversible" or a number of steps, got {checkpoint!r}')
    return checks.count("checkpoint", checkpoint, least=1)
