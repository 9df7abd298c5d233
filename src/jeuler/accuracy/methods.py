"""What may stand in a work-precision table, each as one function from (y0, args) to the states at given times."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.extrapolation import ExtrapolatedStep, solve_adaptive
from jeuler.methods import Step, VectorField
from jeuler.solve import solve

PyTree = Any
MOST_SAVED = 64  # states kept of a run, beside the first
MOST_ADAPTIVE_STEPS = 100_000


@dataclasses.dataclass(frozen=True)
class Compensated:
    """A step to be summed with compensation; in the ``steps`` of `work_precision` only."""

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
        named = dict(steps)
    else:
        steps = [steps] if callable(steps) or is_diffrax(steps) else list(steps)
        named = {getattr(s, "__name__", type(s).__name__).removesuffix("_step"): s for s in steps}
        if len(named) < len(steps):
            raise ValueError("steps given as a list must have different names; pass a dict {name: step}")
    for name, method in named.items():
        inner = method.step if isinstance(method, Compensated) else method
        if not (callable(inner) or is_diffrax(inner)):
            raise ValueError(f"steps[{name!r}] must be a step (f, t, y, dt, args) -> y or a diffrax solver, got {method!r}")
    if not named:
        raise ValueError("steps must name at least one method, got none")
    return named


@dataclasses.dataclass(frozen=True)
class FixedRun:
    """num_steps equal steps of a method from t0 to t1."""

    method: Any
    t0: float
    t1: float
    num_steps: int

    @property
    def dt(self) -> float:
        return (self.t1 - self.t0) / self.num_steps

    @property
    def saved(self) -> int:
        """How many states are kept: the largest divisor of num_steps up to `MOST_SAVED`."""
        return max(d for d in range(1, MOST_SAVED + 1) if self.num_steps % d == 0)

    @property
    def times(self) -> np.ndarray:
        """The times of the states kept."""
        return self.t0 + (self.t1 - self.t0) * np.arange(self.saved + 1) / self.saved

    def __call__(self, f: VectorField, y0: PyTree, args: PyTree, adjoint: Any = None) -> tuple[PyTree, jax.Array, jax.Array]:
        """States at the times, first non-finite step (-1 none), steps taken."""
        if is_diffrax(self.method):
            import diffrax

            times = jnp.asarray(self.times, _time_dtype(y0))
            return _diffrax(
                f, y0, args, self.method, times, self.dt, diffrax.ConstantStepSize(), self.num_steps + 8, adjoint
            )
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

    def shortened(self, num_steps: int) -> FixedRun:
        """The first steps of the run, with the same dt."""
        return FixedRun(self.method, self.t0, self.t0 + num_steps * self.dt, num_steps)


@dataclasses.dataclass(frozen=True)
class AdaptiveRun:
    """A run that chooses its steps by a tolerance, relative and absolute."""

    method: Any
    t0: float
    t1: float
    tolerance: float

    @property
    def times(self) -> np.ndarray:
        return np.array([self.t0, self.t1])

    def __call__(self, f: VectorField, y0: PyTree, args: PyTree, adjoint: Any = None) -> tuple[PyTree, jax.Array, jax.Array]:
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
            return run.y, jnp.where(run.finished, -1, run.num_steps), run.num_steps
        import diffrax

        controller = diffrax.PIDController(rtol=self.tolerance, atol=self.tolerance)
        times = jnp.asarray(self.times, _time_dtype(y0))
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


def _time_dtype(y0: PyTree) -> Any:
    return np.result_type(np.float32, *(np.finfo(leaf.dtype).dtype for leaf in jax.tree.leaves(y0)))


def fixed_grid(method: Any, t0: float, t1: float, dt: float) -> FixedRun:
    """The run whose dt is nearest to the one asked for and divides the interval."""
    return FixedRun(method, t0, t1, max(1, round((t1 - t0) / dt)))


def evaluations(run: FixedRun | AdaptiveRun, f: VectorField, y0: PyTree, args: PyTree, count: Callable) -> float:
    """Evaluations of f in the run: counted over its first steps and scaled, since all are alike but for iterations."""
    if isinstance(run, AdaptiveRun) or run.num_steps <= 8:
        return count(lambda g: run(g, y0, args), f)
    four, eight = (count(lambda g, k=k: run.shortened(k)(g, y0, args), f) for k in (4, 8))
    return math.floor(eight + (eight - four) / 4 * (run.num_steps - 8) + 0.5)
