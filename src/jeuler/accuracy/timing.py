"""Seconds and bytes of a program: compilation apart, every repeat kept."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What a program cost.

    Attributes:
      result: what it returned.
      compile_seconds: tracing, lowering and compiling it.
      run_seconds: each repeat, first run excluded, in the order measured; waits for the result.
      temporary_bytes: peak memory beside inputs and outputs, as the compiler planned it; -1 if it does not say.
    """

    result: Any
    compile_seconds: float
    run_seconds: tuple[float, ...]
    temporary_bytes: int

    @property
    def least(self) -> float:
        return min(self.run_seconds)

    @property
    def median(self) -> float:
        return float(np.median(self.run_seconds))


class Compiled:
    """A program compiled ahead for inputs of one form, and what that took."""

    def __init__(self, function: Callable[..., Any], *inputs: Any) -> None:
        begun = time.perf_counter()
        self.program: Any = jax.jit(function).lower(*inputs).compile()
        self.seconds: float = time.perf_counter() - begun

    def once(self, *inputs: Any) -> tuple[float, Any]:
        """Seconds of one run, and what it returned."""
        begun = time.perf_counter()
        result = jax.block_until_ready(self.program(*inputs))
        return time.perf_counter() - begun, result

    def measure(
        self, *inputs: Any, repeats: int = 5, budget: float = 1.0, patience: float = float("inf")
    ) -> Measurement:
        """Run it once unmeasured, then ``repeats`` times measured.

        Fewer times, but at least once, where they would take more than ``budget`` seconds together. A first run
        longer than ``patience`` seconds is the only one, and is itself the measurement.
        """
        first, result = self.once(*inputs)  # carries one-time costs: pages, threads, caches
        repeats = max(1, min(repeats, int(budget / first)))
        runs = (first,) if first > patience else tuple(self.once(*inputs)[0] for _ in range(repeats))
        memory = self.program.memory_analysis()
        return Measurement(result, self.seconds, runs, getattr(memory, "temp_size_in_bytes", -1))


def measure(
    function: Callable[..., Any], *inputs: Any, repeats: int = 5, budget: float = 1.0, patience: float = float("inf")
) -> Measurement:
    """Compile function for these inputs and measure it."""
    return Compiled(function, *inputs).measure(*inputs, repeats=repeats, budget=budget, patience=patience)


def counting(f: Callable[..., Any]) -> tuple[Callable[..., Any], Callable[[], int]]:
    """f, counting its evaluations as they run (those of loops that end by a test too), and how to read and reset it."""
    count = 0

    def add_one(_: Any) -> None:
        nonlocal count
        count += 1

    def counted(t, y, args):
        jax.debug.callback(add_one, (t, jax.tree.leaves(y)))  # depends on all, so that vmap calls it once a member
        return f(t, y, args)

    def read() -> int:
        nonlocal count
        jax.effects_barrier()
        counted_so_far, count = count, 0
        return counted_so_far

    return counted, read
