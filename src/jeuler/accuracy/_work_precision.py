"""work_precision: what accuracy costs in time, for any methods on one problem."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.partition import arrays_only, is_parameter
from jeuler._core.precision import cast, double_precision, flat, flat_rows, precision
from jeuler.accuracy.reference import (
    Reference,
    ReferenceGradient,
    error_norms,
    make_reference,
    make_reference_gradient,
)
from jeuler.accuracy.runs import (
    AdaptiveRun,
    Compensated,
    FixedRun,
    evaluations,
    fixed_grid,
    is_adaptive,
    is_diffrax,
    named,
)
from jeuler.accuracy.table import EMPTY_ROW, WorkPrecision, mark_pareto
from jeuler.accuracy.timing import measure
from jeuler.steps.explicit import VectorField
from jeuler.steps.stability import stability_limit

PyTree = Any


@says_what_to_write(dt="dts=[...]", num_steps="dts=[...]", step="steps=[...]", methods="steps=[...]")
def work_precision(
    f: VectorField,
    y0: PyTree,
    *,
    t1: float,
    dts: Sequence[float] | np.ndarray,
    steps: Any,
    reference: Any = None,
    t0: float = 0.0,
    args: PyTree = None,
    dtypes: Sequence[Any] | None = None,
    tolerances: Sequence[float] | np.ndarray = (),
    gradient: Callable[[PyTree], jax.Array] | None = None,
    repeats: int = 5,
    timeout: float = 30.0,
    adjoint: Any = None,
    progress: bool | None = None,
) -> WorkPrecision:
    """Error against seconds for each method and each step size, on one problem.

        error(dt) = |y_dt(t) - y(t)|,  at t1, at its largest, and as a root mean square over the saved times

    The steps are equal: each dt becomes the nearest one that divides t1 - t0. Every program is compiled ahead (compile
    seconds apart), run once unmeasured, then measured ``repeats`` times. A run that blows up, or that would take longer
    than ``timeout`` by the speed of the coarser ones before it, is a row of NaN with its reason.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial state, any pytree of floating or complex arrays.
      t1: final time, s.
      dts: step sizes, s.
      steps: ``{name: method}``, or a sequence of steps. A method is a step ``(f, t, y, dt, args) -> y``, such a step
        with compensated sums, ``Compensated(euler_step)``, or a diffrax solver.
      reference: the exact solution, a function of t; or the state at t1; or a diffrax solver, run at tight
        tolerance (take a stiff one for a stiff problem); None runs ``diffrax.Dopri8``. Always in float64.
      t0: initial time, s.
      args: passed to f.
      dtypes: precisions to run in, such as ("float32", "float64"); None takes that of y0.
      tolerances: for methods that choose their own steps, adaptive diffrax solvers and `extrapolated_euler`,
        further rows at these tolerances, relative and absolute alike; no fixed dt.
      gradient: a scalar function of the final state; each row then also has the error, seconds and bytes of its
        reverse-mode derivative with respect to args.
      repeats: measured runs in each row.
      timeout: longest run allowed, s.
      adjoint: how diffrax differentiates, a ``diffrax.AbstractAdjoint``; None takes its default.
      progress: show a bar; None shows it on a terminal once the sweep has lasted two seconds.
    Returns: `WorkPrecision`.
    Raises: ValueError, before anything runs, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> table = jeuler.work_precision(
      ...     lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1, 0.05], steps={"Euler": jeuler.euler_step},
      ...     reference=lambda t: jnp.exp(-t), repeats=1)
      >>> [(row["method"], row["num_steps"], round(row["error_final"], 4)) for row in table.rows]
      [('Euler', 10, 0.0192), ('Euler', 20, 0.0094)]

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.10, work-precision
      diagrams.
    """
    from tqdm.auto import tqdm

    y0 = checks.state("y0", y0)
    checks.untraced("work_precision", y0, args, t0, t1)
    f, args = arrays_only(f, args, is_parameter)
    t0, t1 = checks.interval(t0, t1)
    dts = _positive_values("dts", dts, "s")
    if not dts:
        raise ValueError("dts must name at least one step size, got none")
    if max(dts) > 1.5 * (t1 - t0):
        raise ValueError(f"each of dts must be below t1 - t0 = {t1 - t0:g} s, got {max(dts):g} s; take smaller ones")
    tolerances = _positive_values("tolerances", tolerances)
    repeats = checks.count("repeats", repeats, least=1)
    checks.positive("timeout", timeout, "s")
    methods = named(steps)
    dtypes = [np.dtype(d) for d in ([trees.time_dtype(y0)] if dtypes is None else dtypes)]
    if any(d not in (np.float32, np.float64) for d in dtypes):
        raise ValueError(f"dtypes must be float32 or float64, got {[str(d) for d in dtypes]}")
    with double_precision():
        y64, args64 = cast(y0, np.float64), cast(args, np.float64)
        checks.vector_field(f, t0, y64, args64)
        plans = {name: _plan(method, t0, t1, dts, tolerances) for name, method in methods.items()}
        times = np.unique(np.concatenate([run.times for plan in plans.values() for run in plan]).round(15))
        times = times[np.append(True, np.diff(times) > 1e-9 * (t1 - t0))]
        truth = make_reference(reference, f, y64, args64, times)
        slope = None
        if gradient is not None:
            slope = make_reference_gradient(gradient, reference, f, y64, args64, t0, t1)
        counts = {name: evaluations(plan, f, y64, args64) for name, plan in plans.items()}
        limits = {name: _limit(method, f, t0, y0, args) for name, method in methods.items()}

    rows: list[dict[str, Any]] = []
    total = len(dtypes) * sum(len(plan) for plan in plans.values())
    with tqdm(total=total, delay=2, disable=None if progress is None else not progress, unit="run") as bar:
        for dtype in dtypes:
            with precision(dtype):
                problem = f, cast(y0, dtype), cast(args, dtype)
                for name, plan in plans.items():
                    pace = 0.0  # seconds a step of the run before, coarser
                    for run, count in zip(plan, counts[name], strict=True):
                        bar.set_postfix_str(f"{name} {dtype}")
                        row = EMPTY_ROW | {"method": name, "dtype": str(dtype)}
                        row |= _row(run, problem, truth, pace, repeats, timeout)
                        row["evaluations"] = count(row["num_steps"]) if row["num_steps"] > 0 else -1
                        if slope is not None and not row["reason"]:
                            row |= _gradient_row(run, problem, gradient, slope, repeats, timeout, adjoint)
                        if isinstance(run, FixedRun) and math.isfinite(row["run_seconds_min"]):
                            pace = row["run_seconds_min"] / run.num_steps
                        rows.append(row)
                        bar.update()
    mark_pareto(rows, truth.error)
    return WorkPrecision(rows=rows, stability_limits=limits, reference_error=truth.error, interval=(t0, t1))


def _plan(method: Any, t0: float, t1: float, dts: list[float], tolerances: list[float]) -> list[FixedRun | AdaptiveRun]:
    """The runs of a method from coarse to fine, each grid once."""
    fixed = {run.num_steps: run for run in (fixed_grid(method, t0, t1, dt) for dt in sorted(dts, reverse=True))}
    loose_first = sorted(tolerances, reverse=True) if is_adaptive(method) else []
    return [*fixed.values(), *(AdaptiveRun(method, t0, t1, tolerance) for tolerance in loose_first)]


def _row(run, problem, truth: Reference, pace: float, repeats: int, timeout: float) -> dict[str, Any]:
    f, y0, args = problem
    if isinstance(run, AdaptiveRun):
        row = {"tolerance": run.tolerance}
    else:
        row = {"dt": run.dt, "num_steps": run.num_steps}
        if pace * run.num_steps > timeout:
            return row | {"reason": f"would take {pace * run.num_steps:.3g} s, more than timeout={timeout:g} s"}
    try:
        cost = measure(lambda y0, args: run(f, y0, args), y0, args, repeats=repeats, patience=timeout)
    except RuntimeError as failure:  # what an implicit solve raises at run time
        return row | {"reason": str(failure).strip().splitlines()[0][:200]}
    states, lost, num_steps = cost.result
    row |= {
        "num_steps": int(num_steps),
        "compile_seconds": cost.compile_seconds,
        "run_seconds": cost.run_seconds,
        "run_seconds_min": cost.least,
        "run_seconds_median": cost.median,
    }
    if cost.least > timeout:
        return row | {"reason": f"took {cost.least:.3g} s, more than timeout={timeout:g} s"}
    states = flat_rows(states)
    if int(lost) >= 0 or not np.all(np.isfinite(states)):
        at = f"at step {int(lost)}" if int(lost) >= 0 else "at the end"
        return row | {"reason": f"blew up: not finite {at} of {int(num_steps)}"}
    return row | error_norms(states, truth.at(run.times))


def _gradient_row(run, problem, scalar, truth: ReferenceGradient, repeats, timeout, adjoint) -> dict[str, Any]:
    f, y0, args = problem

    def final(args):
        return scalar(jax.tree.map(lambda leaf: leaf[-1], run(f, y0, args, adjoint)[0]))

    cost = measure(jax.grad(final), args, repeats=repeats, patience=timeout)
    error, size = float(np.linalg.norm(flat(cost.result) - truth.value)), float(np.linalg.norm(truth.value))
    return {
        "gradient_error": error,
        "gradient_error_relative": error / size if size else math.nan,
        "gradient_compile_seconds": cost.compile_seconds,
        "gradient_seconds": cost.run_seconds,
        "gradient_seconds_min": cost.least,
        "gradient_seconds_median": cost.median,
        "gradient_bytes": cost.temporary_bytes,
    }


def _limit(method: Any, f: VectorField, t0: float, y0: PyTree, args: PyTree) -> float:
    """The stability limit at the start; NaN for a diffrax solver, whose step is not ours to call."""
    if is_diffrax(method):
        return math.nan
    step = method.step if isinstance(method, Compensated) else method
    try:
        return stability_limit(f, t0, y0, args, step=step, growing="skip")
    except (
        ValueError,
        TypeError,
        np.linalg.LinAlgError,
    ):  # a Jacobian that is not finite, a step that is not linear
        return math.nan


def _positive_values(name: str, values: Any, unit: str = "") -> list[float]:
    try:
        if isinstance(values, str) or np.ndim(values) > 1:
            raise TypeError
        values = np.atleast_1d(np.asarray(values)).tolist()
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a list of numbers above 0, got {checks.shown(values)}") from None
    for value in values:
        checks.positive(f"each of {name}", value, unit)
    return values
