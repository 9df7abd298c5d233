"""Evaluations of f, counted while a run takes its steps; and where the steps of an adaptive run ended."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.precision import flat
from jeuler.accuracy.method import Method, is_diffrax
from jeuler.accuracy.runs import AdaptiveRun, FixedRun, adaptive_program, fixed_program
from jeuler.accuracy.timing import counting
from jeuler.steps.explicit import VectorField

PyTree = Any
FEW, MANY = 8, 1000  # steps that are counted one by one, of steps that are all alike and of those that iterate


class FixedCounter:
    """Evaluations of the runs of equal steps of one method.

    Steps that are all alike are counted over the first 8, which is exact; steps that iterate over the first 1,000, and
    the rest by the mean of the second half of these. Products with the Jacobian of f are not counted.
    """

    def __init__(self, method: Method, f: VectorField, y0: PyTree, args: PyTree, t0: float) -> None:
        self.read: Callable[[], int]
        self.program: Callable[..., Any]
        counted, self.read = counting(f)
        self.inputs: tuple[PyTree, PyTree] = (y0, args)
        self.most = MANY if method.iterates else FEW
        self.program = jax.jit(fixed_program(method, counted, t0, self.most))

    def first(self, run: FixedRun, num_steps: int) -> int:
        """Evaluations of so many first steps."""
        dt, ends = run.inputs(trees.time_dtype(self.inputs[0]), self.most, first=num_steps)
        jax.block_until_ready(self.program(*self.inputs, dt, ends[-1:]))
        return self.read()

    def __call__(self, run: FixedRun) -> int:
        if run.num_steps <= self.most:
            return self.first(run, run.num_steps)
        half, whole = self.first(run, self.most // 2), self.first(run, self.most)
        return round(whole + (run.num_steps - self.most) * (whole - half) / (self.most - self.most // 2))


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Where the steps of an adaptive run began, the state there, and the evaluations of all of them.

    Attributes:
      times: (step,), s, from t0.
      states: (step, number).
      evaluations: how many.
    """

    times: np.ndarray
    states: np.ndarray
    evaluations: int


class AdaptiveCounter:
    """Evaluations and accepted steps of the runs by tolerance of one method, each run counted whole."""

    def __init__(self, method: Method, f: VectorField, y0: PyTree, args: PyTree, times: np.ndarray) -> None:
        self.read: Callable[[], int]
        self.program: Callable[..., Any]
        counted, self.read = counting(f)
        self.record: list[tuple[float, np.ndarray]] = []
        if not is_diffrax(method.step):
            method = dataclasses.replace(method, step=Recorded(method.step, self.keep))
        self.inputs: tuple[PyTree, PyTree] = (y0, args)
        self.program = jax.jit(adaptive_program(method, counted, times))

    def keep(self, t: Any, y: Any) -> None:
        self.record.append((float(t), flat(y)))

    def __call__(self, run: AdaptiveRun) -> Trajectory:
        dtype = trees.time_dtype(self.inputs[0])
        tolerances = jnp.asarray(run.rtol, dtype), jnp.asarray(run.atol, dtype)
        jax.block_until_ready(self.program(*self.inputs, *tolerances))
        evaluations = self.read()  # waits for all that was to be noted
        noted = dict(sorted(self.record, key=lambda entry: entry[0]))
        self.record.clear()
        states = np.stack(list(noted.values())) if noted else np.zeros((0, 0))
        return Trajectory(np.array(list(noted)), states, evaluations)


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A step for `solve_adaptive` that notes where each of its trials begins."""

    step: Any
    keep: Callable[..., None]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.step, name)

    def attempt(
        self, f: VectorField, t: Any, y: PyTree, taken_over: PyTree, dt: Any, args: Any
    ) -> tuple[PyTree, PyTree, PyTree]:
        jax.debug.callback(self.keep, t, y)
        return self.step.attempt(f, t, y, taken_over, dt, args)
