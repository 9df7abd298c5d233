"""The rows of a work-precision table: each run measured, counted and compared with the reference."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.precision import flat, flat_rows
from jeuler.accuracy.counts import AdaptiveCounter, FixedCounter, Trajectory
from jeuler.accuracy.method import Method, is_diffrax
from jeuler.accuracy.plan import Plan
from jeuler.accuracy.reference import Reference, ReferenceGradient, error_norms
from jeuler.accuracy.runs import AdaptiveRun, FixedRun, adaptive_program, final_state, fixed_program
from jeuler.accuracy.timing import Compiled, Measurement, measure
from jeuler.steps.explicit import VectorField

PyTree = Any
PILOT = 16  # steps that tell how long a run would take


@dataclasses.dataclass(frozen=True)
class Count:
    """Evaluations of one run, and for a run by tolerance whose program does not say, its states along the way."""

    evaluations: int
    trajectory: Trajectory | None = None


def thinned(count: Count, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and states of a recorded trajectory, at most so many; empty where there is none."""
    path = count.trajectory
    if path is None:
        return np.zeros(0), np.zeros((0, 0))
    chosen = np.unique(np.round(np.linspace(0, len(path.times) - 1, min(points, len(path.times)))).astype(int))
    return path.times[chosen], path.states[chosen]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What all rows of a table share."""

    f: VectorField
    t0: float
    t1: float
    points: int
    repeats: int
    timeout: float
    gradient: Callable[..., Any] | None
    adjoint: Any

    @property
    def moments(self) -> np.ndarray:
        """Even times over the run."""
        return self.t0 + (self.t1 - self.t0) * np.arange(self.points + 1) / self.points

    def moments_of(self, method: Method) -> np.ndarray:
        """When a run by tolerance is looked at."""
        return self.moments if is_diffrax(method.step) else self.moments[[0, -1]]

    def count(self, plan: Plan, y0: PyTree, args: PyTree) -> list[Count]:
        """Evaluations of each run of a plan."""
        found = []
        if plan.fixed:
            counter = FixedCounter(plan.method, self.f, y0, args, self.t0)
            found += [Count(counter(run)) for run in plan.fixed]
        if plan.adaptive:
            record = AdaptiveCounter(plan.method, self.f, y0, args, self.moments_of(plan.method))
            paths = [record(run) for run in plan.adaptive]
            found += [Count(path.evaluations, path if path.times.size else None) for path in paths]
        return found

    def rows(
        self, plan: Plan, inputs: Any, counts: list[Count], truth: Reference, slope: Any, norm: Any
    ) -> Iterator[dict[str, Any]]:
        """A row for each run of a plan."""
        counted = iter(counts)
        if plan.fixed:
            most = max(run.num_steps for run in plan.fixed)
            dtype = trees.time_dtype(inputs[0])
            program = Compiled(
                fixed_program(plan.method, self.f, self.t0, most), *inputs, *plan.fixed[0].inputs(dtype, most)
            )
            for run in plan.fixed:
                row = {"dt": run.dt, "num_steps": run.num_steps, "evaluations": next(counted).evaluations}
                row |= self.fixed_row(program, run, inputs, most, truth, norm)
                yield row | self.gradient_row(plan.method, run, inputs, slope, row)
        if plan.adaptive:
            times = self.moments_of(plan.method)
            first = [
                jnp.asarray(x, trees.time_dtype(inputs[0])) for x in (plan.adaptive[0].rtol, plan.adaptive[0].atol)
            ]
            program = Compiled(adaptive_program(plan.method, self.f, times), *inputs, *first)
            for by_tolerance in plan.adaptive:
                count = next(counted)
                row = dataclasses.asdict(by_tolerance) | {"evaluations": count.evaluations}
                row |= self.adaptive_row(program, by_tolerance, inputs, times, count, truth, norm)
                yield row | self.gradient_row(plan.method, by_tolerance, inputs, slope, row)

    def fixed_row(
        self, program: Compiled, run: FixedRun, inputs: Any, most: int, truth: Reference, norm: Any
    ) -> dict[str, Any]:
        """What a run of equal steps adds to its row."""
        sizes = functools.partial(run.inputs, trees.time_dtype(inputs[0]), most)
        try:
            if run.num_steps > PILOT:
                program.once(*inputs, *sizes(1))
                few, many = (program.once(*inputs, *sizes(n))[0] for n in (1, PILOT))
                expected = max(many - few, 0.0) / (PILOT - 1) * run.num_steps
                if expected > self.timeout:
                    return {"reason": f"would take {expected:.3g} s, more than timeout={self.timeout:g} s"}
            cost = program.measure(*inputs, *sizes(), repeats=self.repeats, patience=self.timeout)
        except RuntimeError as failure:  # what an implicit solve raises at run time
            return {"reason": str(failure).strip().splitlines()[0][:200]}
        states = flat_rows(cost.result[0])[: len(run.times)]
        return self.measured(cost, states, run.times, truth, norm)

    def adaptive_row(
        self, program: Compiled, run: AdaptiveRun, inputs: Any, times: Any, count: Count, truth: Reference, norm: Any
    ) -> dict[str, Any]:
        """What a run by tolerance adds to its row."""
        tolerances = [jnp.asarray(x, trees.time_dtype(inputs[0])) for x in (run.rtol, run.atol)]
        try:
            cost = program.measure(*inputs, *tolerances, repeats=self.repeats, patience=self.timeout)
        except RuntimeError as failure:
            return {"reason": str(failure).strip().splitlines()[0][:200]}
        states = flat_rows(cost.result[0])
        if count.trajectory is not None:
            times, before = thinned(count, self.points)
            times, states = np.append(times, self.t1), np.concatenate([before, states[-1:]])
        return self.measured(cost, states, times, truth, norm)

    def measured(
        self, cost: Measurement, states: np.ndarray, times: np.ndarray, truth: Reference, norm: Any
    ) -> dict[str, Any]:
        """Seconds and errors of a run, or why there are none."""
        _, lost, num_steps = cost.result
        row = {
            "num_steps": int(num_steps),
            "compile_seconds": cost.compile_seconds,
            "run_seconds": cost.run_seconds,
            "run_seconds_min": cost.least,
            "run_seconds_median": cost.median,
        }
        if cost.least > self.timeout:
            return row | {"reason": f"took {cost.least:.3g} s, more than timeout={self.timeout:g} s"}
        if int(lost) >= 0 or not np.all(np.isfinite(states)):
            at = f"at step {int(lost)}" if int(lost) >= 0 else "at the end"
            return row | {"reason": f"blew up: not finite {at} of {int(num_steps)}"}
        return row | error_norms(states, truth.at(times), times, norm)

    def gradient_row(
        self, method: Method, run: Any, inputs: Any, slope: ReferenceGradient | None, row: dict[str, Any]
    ) -> dict[str, Any]:
        """What the reverse-mode derivative of a run adds to its row."""
        if slope is None or row.get("reason"):
            return {}
        y0, args = inputs
        final = final_state(method, run, self.f, self.t0, self.t1, self.adjoint)
        assert self.gradient is not None
        scalar = self.gradient
        cost = measure(
            jax.grad(lambda args: scalar(final(y0, args))), args, repeats=self.repeats, patience=self.timeout
        )
        error, size = float(np.linalg.norm(flat(cost.result) - slope.value)), float(np.linalg.norm(slope.value))
        return {
            "gradient_error": error,
            "gradient_error_relative": error / size if size else math.nan,
            "gradient_compile_seconds": cost.compile_seconds,
            "gradient_seconds": cost.run_seconds,
            "gradient_seconds_min": cost.least,
            "gradient_seconds_median": cost.median,
            "gradient_bytes": cost.temporary_bytes,
        }
