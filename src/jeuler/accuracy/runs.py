"""What may stand in a work-precision table, each as one function from (y0, args) to the states at given times."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.component import result
from jeuler.accuracy.timing import counting
from jeuler.solving._adaptive import solve_adaptive
from jeuler.solving._scan import solve
from jeuler.steps.explicit import Step, VectorField
from jeuler.steps.extrapolated import ExtrapolatedStep

PyTree = Any
MOST_SAVED = 64  # states kept of a run, beside the first
MOST_ADAPTIVE_STEPS = 100_000


@result
class Compensated:
    """A step to be summed with compensation; in the ``steps`` of `work_precision` only.

    Args:
      step: an explicit step.
    Raises: ValueError, in `work_precision`, if the step has no increment.
    Example:
      >>> import jeuler
      >>> jeuler.Compensated(jeuler.euler_step).step is jeuler.euler_step
      True

    Source: A. Neumaier, Rundungsfehleranalyse einiger Verfahren zur Summation endlicher Summen, 1974.
    """

    step: Step


def is_diffrax(method: Any) -> bool:
    import diffrax

    return isinstance(method, diffrax.AbstractSolver)


def is_adaptive(method: Any) -> bool:
    """Whether the method can choose its own steps from a tolerance."""
    if isinstance(method, ExtrapolatedStep):
        return method.order > 1
    if is_diffrax(method):
        import diffrax

        return isinstance(method, diffrax.AbstractAdaptiveSolver)
    return False


def named(steps: Any) -> dict[str, Any]:
    """``steps`` as a dictionary: a mapping as it is, a sequence by the names of its functions."""
    if isinstance(steps, Mapping):
        methods = dict(steps)
    else:
        if isinstance(steps, str) or not (callable(steps) or is_diffrax(steps) or isinstance(steps, Iterable)):
            raise ValueError(f"steps must be a list of steps or a dict {{name: step}}, got {steps!r}")
        steps = [steps] if callable(steps) or is_diffrax(steps) else list(steps)
        methods = {getattr(s, "__name__", type(s).__name__).removesuffix("_step"): s for s in steps}
        if len(methods) < len(steps):
            raise ValueError("steps given as a list must have different names; pass a dict {name: step}")
    for name, method in methods.items():
        inner = method.step if isinstance(method, Compensated) else method
        if not (callable(inner) or is_diffrax(inner)):
            raise ValueError(
                f"steps[{name!r}] must be a step (f, t, y, dt, args) -> y or a diffrax solver, got {method!r}"
            )
    if not methods:
        raise ValueError("steps must name at least one method, got none")
    return methods


@dataclasses.dataclass(frozen=True)
class FixedRun:
    """num_steps equal steps of a method from t0."""

    method: Any
    t0: float
    dt: Any
    num_steps: int

    @property
    def saved(self) -> int:
        """How many states are kept: the largest divisor of num_steps up to `MOST_SAVED`."""
        return max(d for d in range(1, MOST_SAVED + 1) if self.num_steps % d == 0)

    @property
    def times(self) -> Any:
        """The times of the states kept."""
        return self.t0 + self.num_steps * self.dt * (np.arange(self.saved + 1) / self.saved)

    def __call__(
        self, f: VectorField, y0: PyTree, args: PyTree, adjoint: Any = None
    ) -> tuple[PyTree, jax.Array, jax.Array]:
        """States at the times, first non-finite step (-1 none), steps taken."""
        if is_diffrax(self.method):
            import diffrax

            times = jnp.asarray(self.times, trees.time_dtype(y0))
            equal, most = diffrax.ConstantStepSize(), self.num_steps + 8
            return _diffrax(f, y0, args, self.method, times, self.dt, equal, most, adjoint)
        compensated = isinstance(self.method, Compensated)
        run = solve(
            f,
            y0,
            dt=self.dt,
            num_steps=self.num_steps,
            t0=self.t0,
            args=args,
            step=self.method.step if compensated else self.method,
            save_every=self.num_steps // self.saved,
            compensated=compensated,
        )
        return run.y, run.first_nonfinite, jnp.int32(self.num_steps)


@dataclasses.dataclass(frozen=True)
class AdaptiveRun:
    """A run that chooses its steps by a tolerance, relative and absolute."""

    method: Any
    t0: float
    t1: float
    tolerance: Any

    @property
    def times(self) -> np.ndarray:
        return np.array([self.t0, self.t1])

    def __call__(
        self, f: VectorField, y0: PyTree, args: PyTree, adjoint: Any = None
    ) -> tuple[PyTree, jax.Array, jax.Array]:
        if isinstance(self.method, ExtrapolatedStep):
            run = solve_adaptive(
                f,
                y0,
                t0=self.t0,
                t1=self.t1,
                args=args,
                step=self.method,
                rtol=self.tolerance,
                atol=self.tolerance,
                max_steps=MOST_ADAPTIVE_STEPS,
            )
            tried = run.num_steps + run.num_rejected
            return run.y, jnp.where(run.finished, -1, tried), tried
        import diffrax

        controller = diffrax.PIDController(rtol=self.tolerance, atol=self.tolerance)
        times = jnp.asarray(self.times, trees.time_dtype(y0))
        return _diffrax(f, y0, args, self.method, times, None, controller, MOST_ADAPTIVE_STEPS, adjoint)


def _diffrax(f, y0, args, solver, times, dt0, controller, most, adjoint):
    import diffrax

    run = diffrax.diffeqsolve(
        diffrax.ODETerm(f),
        solver,
        times[0],
        times[-1],
        None if dt0 is None else jnp.asarray(dt0, times.dtype),
        y0,
        args,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=controller,
        max_steps=most,
        throw=False,
        **({} if adjoint is None else {"adjoint": adjoint}),
    )
    failed = jnp.where(run.result == diffrax.RESULTS.successful, -1, run.stats["num_steps"])
    return run.ys, failed, run.stats["num_steps"]


def fixed_grid(method: Any, t0: float, t1: float, dt: float) -> FixedRun:
    """The run whose dt is nearest to the one asked for and divides the interval."""
    num_steps = max(1, round((t1 - t0) / dt))
    return FixedRun(method, t0, (t1 - t0) / num_steps, num_steps)


def evaluations(
    plan: Sequence[FixedRun | AdaptiveRun], f: VectorField, y0: PyTree, args: PyTree
) -> list[Callable[..., Any]]:
    """For each run of one method, evaluations of f as a function of the steps it took; counted while steps are taken.

    A run of equal steps is counted over its first 4 and 8 steps, an adaptive one over its whole length, and scaled to
    the steps taken: exact but for steps that iterate. Products with the Jacobian of f are not counted.
    """

    def counter(make_run: Callable[..., Any]) -> Callable[..., Any]:
        counted, read = counting(f)
        program = jax.jit(lambda x: make_run(x)(counted, y0, args)[2])

        def count(x: float) -> tuple[int, int]:
            num_steps = int(program(x))
            return read(), num_steps

        return count

    def fixed(num_steps):
        return counter(lambda dt: FixedRun(plan[0].method, plan[0].t0, dt, num_steps))

    four, eight = fixed(4), fixed(8)
    adaptive_runs = [run for run in plan if isinstance(run, AdaptiveRun)]
    adaptive = counter(lambda tolerance: dataclasses.replace(adaptive_runs[0], tolerance=tolerance))
    laws = []
    for run in plan:
        if isinstance(run, AdaptiveRun):
            all_of_them, taken = adaptive(run.tolerance)
            first, each = 0.0, all_of_them / taken
        else:
            few, more = four(run.dt)[0], eight(run.dt)[0]
            first, each = 2 * few - more, (more - few) / 4
        laws.append(lambda num_steps, first=first, each=each: round(first + each * num_steps))
    return laws
