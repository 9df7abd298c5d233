"""work_precision: what accuracy costs in time and in evaluations, for any methods on one problem."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.partition import arrays_only, is_parameter
from jeuler._core.precision import cast, double_precision, precision
from jeuler.accuracy.method import is_diffrax, named
from jeuler.accuracy.plan import Plan, make_plans
from jeuler.accuracy.reference import Norm, distinct, make_reference, make_reference_gradient
from jeuler.accuracy.sweep import Sweep, thinned
from jeuler.accuracy.table import EMPTY_ROW, WorkPrecision, mark_pareto
from jeuler.steps.explicit import VectorField
from jeuler.steps.stability import Linearisation

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
    tolerances: Sequence[Any] | np.ndarray = (),
    norm: Callable[[PyTree], Any] | None = None,
    points: int = 64,
    gradient: Callable[[PyTree], jax.Array] | None = None,
    repeats: int = 5,
    timeout: float = 30.0,
    adjoint: Any = None,
    problem: str = "",
    progress: bool | None = None,
) -> WorkPrecision:
    """Error against seconds and evaluations for each method and each step size, on one problem.

        error(dt) = |y_dt(t) - y(t)|,  at t1, at its largest, and as a root mean square over the run

    The steps are equal: each dt becomes the nearest one that divides t1 - t0. One program serves all step sizes of a
    method, and one all its tolerances; a gradient has one for each row. Each is compiled ahead (compile seconds apart),
    run once unmeasured, then measured ``repeats`` times, or as often as fits into 1 s, at least once. A run that blows
    up, or that would take longer than ``timeout`` by the speed of its first steps, is a row of NaN with its reason.

    To add a method later, or put several problems in one table, add tables: ``table + work_precision(...)``.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial state, any pytree of floating or complex arrays.
      t1: final time, s.
      dts: step sizes, s.
      steps: ``{name: method}``, or a sequence of steps. A method is a step ``(f, t, y, dt, args) -> y``, such a step
        with compensated sums, ``Compensated(euler_step)``, a diffrax solver, or one of these with its own step sizes,
        tolerances and options, a `Method`.
      reference: the exact solution, a function of t; or the state at t1; or a diffrax solver, run at tight
        tolerance (take a stiff one for a stiff problem); None runs ``diffrax.Dopri8``. Always in float64.
      t0: initial time, s.
      args: passed to f.
      dtypes: precisions to run in, such as ("float32", "float64"); None takes that of y0.
      tolerances: for methods that choose their own steps, adaptive diffrax solvers and `extrapolated_euler`, further
        rows at these tolerances: pairs (rtol, atol), or numbers for both alike.
      norm: a function of a difference of states, of the form of y0, that returns its size; None takes the Euclidean
        norm over all numbers of the state.
      points: states of a run that are compared, evenly over time, for its largest and mean error: ends of steps, or
        where a diffrax solver chooses its own steps what it interpolates.
      gradient: a scalar function of the final state; each row then also has the error, seconds and bytes of its
        reverse-mode derivative with respect to args.
      repeats: most measured runs in each row.
      timeout: longest run allowed, s.
      adjoint: how diffrax differentiates, a ``diffrax.AbstractAdjoint``; None takes its default.
      problem: a name for the problem, to tell it from others in one table.
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
    repeats, points = checked_counts(problem, repeats, points, timeout)
    plans, dtypes = make_plans(named(steps), dts, tolerances, t0, t1, points), checked_dtypes(dtypes, y0)
    sweep = Sweep(f, t0, t1, points, repeats, timeout, gradient, adjoint)
    with double_precision():
        y64, args64 = cast(y0, np.float64), cast(args, np.float64)
        checks.vector_field(f, t0, y64, args64)
        size = None if norm is None else Norm(norm, y64)
        limits = stability_limits(plans, f, t0, y0, args)
    counts = {}
    for dtype in dtypes:
        with precision(dtype):
            counts[dtype] = [sweep.count(plan, cast(y0, dtype), cast(args, dtype)) for plan in plans]
    with double_precision():
        states = [t for of in counts.values() for plan in of for count in plan for t in thinned(count, points)[0]]
        looked_at = [t0, t1, *sweep.moments, *(t for plan in plans for run in plan.fixed for t in run.times), *states]
        truth = make_reference(reference, f, y64, args64, distinct(np.array(looked_at), t0, t1), size)
        slope = gradient and make_reference_gradient(gradient, reference, f, y64, args64, t0, t1)
    same = {"problem": problem, "t0": t0, "t1": t1, "reference_error": truth.error}
    total = len(dtypes) * sum(len(plan.runs) for plan in plans)
    rows: list[dict[str, Any]] = []
    with tqdm(total=total, delay=2, disable=None if progress is None else not progress, unit="run") as bar:
        for dtype in dtypes:
            with precision(dtype):
                inputs = cast(y0, dtype), cast(args, dtype)
                for plan, of_plan, limit in zip(plans, counts[dtype], limits, strict=True):
                    bar.set_postfix_str(f"{plan.name} {dtype}")
                    whose = {"method": plan.name, "dtype": str(dtype), "stability_limit": limit}
                    for row in sweep.rows(plan, inputs, of_plan, truth, slope, size):
                        rows.append(EMPTY_ROW | same | whose | row)
                        bar.update()
    mark_pareto(rows)
    return WorkPrecision(rows=rows)


def stability_limits(plans: list[Plan], f: VectorField, t0: float, y0: PyTree, args: PyTree) -> list[float]:
    """That of each plan's step at the start; NaN for a diffrax solver, whose step is not ours to call."""
    linear = Linearisation(f, y0, args)

    def limit(step: Any) -> float:
        if is_diffrax(step):
            return math.nan
        try:
            return float(linear.limit(t0, linear.flat, step, growing="skip"))
        except (ValueError, TypeError, np.linalg.LinAlgError):  # a Jacobian that is not finite, a step not linear
            return math.nan

    return [limit(plan.method.step) for plan in plans]


def checked_counts(problem: Any, repeats: Any, points: Any, timeout: Any) -> tuple[int, int]:
    """How many measured runs and times there are, or one ValueError."""
    if not isinstance(problem, str):
        raise ValueError(f"problem must be a string, the name of the problem, got {checks.shown(problem)}")
    checks.positive("timeout", timeout, "s")
    return checks.count("repeats", repeats, least=1), checks.count("points", points, least=1)


def checked_dtypes(dtypes: Any, y0: PyTree) -> list[np.dtype]:
    """The precisions to run in, or one ValueError."""
    found = [np.dtype(d) for d in ([trees.time_dtype(y0)] if dtypes is None else dtypes)]
    if any(d not in (np.float32, np.float64) for d in found):
        raise ValueError(f"dtypes must be float32 or float64, got {[str(d) for d in found]}")
    return found
