"""Pilot runs: the final state for any number of steps from one compiled program, and what a ladder of them says."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.component import Function
from jeuler._core.precision import cast, flat_rows, precision
from jeuler._jax import programs
from jeuler.solving._breaks import checked_breaks
from jeuler.solving._scan import solve_to
from jeuler.steps.explicit import Step, VectorField

PyTree = Any
SAMPLES = 8  # states kept of a pilot run, at which its stability is looked at


class Pilot:
    """Runs of one step on one problem; the number of steps is an input of the program, not a part of it."""

    dtype: Any
    interval: float
    program: Callable[..., Any]

    def __init__(
        self,
        f: VectorField,
        y0: PyTree,
        t0: float,
        t1: float,
        args: PyTree,
        step: Step,
        dtype: Any,
        compensated: bool,
        breaks: tuple[float, ...] = (),
    ) -> None:
        self.dtype, self.interval = dtype, t1 - t0
        with precision(dtype):
            known = checked_breaks(breaks, dtype) if breaks else None
            inputs = Function(f), Function(step), cast(y0, dtype), cast(args, dtype), jnp.asarray(t0, dtype), known
        self.program = lambda dt, ends: programs.call(_pilot_run, (*inputs, dt, ends), (compensated,))

    def __call__(self, num_steps: int) -> np.ndarray:
        """States at the ends of eight parts of the interval: (part, number), the last one at t1."""
        with precision(self.dtype):
            ends = jnp.asarray(np.arange(1, SAMPLES + 1) * num_steps // SAMPLES, jnp.int32)
            dt = jnp.asarray(self.interval / num_steps, self.dtype)
            return flat_rows(self.program(dt, ends))


def _pilot_run(
    f: VectorField,
    step: Step,
    y0: PyTree,
    args: PyTree,
    t0: Array,
    breaks: Any,
    dt: Array,
    ends: Array,
    compensated: bool,
) -> PyTree:
    """The states after these numbers of steps."""
    states, _ = solve_to(
        f,
        y0,
        dt=dt,
        ends=ends,
        t0=t0,
        args=args,
        step=step,
        compensated=compensated,
        breaks=() if breaks is None else breaks,
    )
    return jax.tree.map(lambda leaf: leaf[1:], states)


@dataclasses.dataclass
class Ladder:
    """Final states for numbers of steps that double, and their extrapolation to dt = 0 (Richardson, Aitken-Neville).

    T_{j,m+1} = T_{j,m} + (T_{j,m} - T_{j-1,m}) / (2^(p+m-1) - 1),  p the order of the step
    """

    order: int
    num_steps: list[int] = dataclasses.field(default_factory=list)
    finals: list[np.ndarray] = dataclasses.field(default_factory=list)
    best: np.ndarray | None = None  # the extrapolated state at t1
    doubt: float = np.inf  # norm of its last change: how far it may be trusted

    def add(self, num_steps: int, final: np.ndarray) -> None:
        self.num_steps.append(num_steps)
        self.finals.append(final)
        if not np.all(np.isfinite(final)):  # what was before an unstable run says nothing
            self.num_steps.clear()
            self.finals.clear()
        self._extrapolate()

    def _extrapolate(self) -> None:
        self.best, self.doubt = None, np.inf
        column = self.finals[-6:]
        for m in range(min(5, len(column) - 1)):
            factor = 2.0 ** (self.order + m) - 1
            with np.errstate(over="ignore", invalid="ignore"):  # the runs before may have grown beyond all bounds
                finer = [b + (b - a) / factor for a, b in itertools.pairwise(column)]
            # two entries of the new column must agree, or one new entry be near the column before
            change = distance(finer[-1], finer[-2] if len(finer) > 1 else column[-1])
            if change < self.doubt:
                self.best, self.doubt = finer[-1], change
            column = finer

    def error_of(self, final: np.ndarray) -> float:
        """Norm of a final state's difference from the extrapolated one; inf where either is not finite."""
        error = np.inf if self.best is None else distance(final, self.best)
        return error if np.isfinite(error) else np.inf

    def errors(self) -> np.ndarray:
        """The error of each run so far."""
        return np.array([self.error_of(final) for final in self.finals])

    def observed_orders(self) -> np.ndarray:
        """log2 of the ratio of the errors of neighbours."""
        errors = np.maximum(self.errors(), 1e-300)
        with np.errstate(over="ignore", invalid="ignore"):  # NaN between two that are not finite
            return np.log2(errors[:-1] / errors[1:])


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Euclidean norm of the difference of two states; inf or NaN, without a warning, where one is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return norm(a - b)


def norm(x: np.ndarray) -> float:
    """Euclidean norm, also of numbers whose squares are too large or too small."""
    with np.errstate(over="ignore", invalid="ignore"):
        plain, largest = float(np.linalg.norm(x)), float(np.max(np.abs(x), initial=0.0))
        if 1e-140 < plain < np.inf or not 0 < largest < np.inf:
            return plain
        return largest * float(np.linalg.norm(x / largest))
