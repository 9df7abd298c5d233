"""The runs of one method: a program for all numbers of steps, one for all tolerances, and their gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler.accuracy.method import Method, is_diffrax
from jeuler.solving._adaptive import solve_adaptive
from jeuler.solving._scan import solve, solve_to
from jeuler.solving.grid import COUNTER
from jeuler.steps.explicit import VectorField

PyTree = Any
MOST_ADAPTIVE_STEPS = 100_000
Program = Callable[..., tuple[PyTree, jax.Array, jax.Array]]  # states, first non-finite step (-1 none), steps taken


@dataclasses.dataclass(frozen=True)
class FixedRun:
    """num_steps equal steps from t0, whose states are looked at after some of them."""

    t0: float
    dt: float
    num_steps: int
    points: int

    @property
    def ends(self) -> np.ndarray:
        """After how many steps: evenly, or as evenly as steps allow where half of the points cannot be had so."""
        even = max(d for d in range(1, self.points + 1) if self.num_steps % d == 0)
        count = even if even >= self.points / 2 else min(self.points, self.num_steps)
        return np.round(np.arange(1, count + 1) * (self.num_steps / count)).astype(np.int64)

    @property
    def times(self) -> np.ndarray:
        """t0, and the times of the states looked at."""
        return self.t0 + self.dt * np.append(0, self.ends)

    def inputs(self, dtype: Any, most: int, first: int | None = None) -> tuple[jax.Array, jax.Array]:
        """What `fixed_program` takes: dt and as many ends for each run; of the first steps only, where that is asked.

        most: the largest number of steps among the runs that share the program.
        """
        ends = np.append(self.ends, np.full(self.points - self.ends.size, self.num_steps))
        counter = jnp.int32 if most <= COUNTER else jnp.int64
        return jnp.asarray(self.dt, dtype), jnp.asarray(np.minimum(ends, first or self.num_steps), counter)


@dataclasses.dataclass(frozen=True)
class AdaptiveRun:
    """A run that chooses its steps by a tolerance, relative and absolute."""

    rtol: float
    atol: float


def fixed_grid(t0: float, t1: float, dt: float, points: int) -> FixedRun:
    """The run whose dt is nearest to the one asked for and divides the interval."""
    num_steps = max(1, round((t1 - t0) / dt))
    return FixedRun(t0, (t1 - t0) / num_steps, num_steps, points)


def fixed_program(method: Method, f: VectorField, t0: float, most: int) -> Program:
    """``run(y0, args, dt, ends)``: y0 and the states after these numbers of steps; one program for all of a method.

    most: the largest number of steps.
    """
    options = dict(method.options)

    def run(y0, args, dt, ends):
        if is_diffrax(method.step):
            import diffrax

            times = jnp.asarray(t0, dt.dtype) + dt * jnp.append(0, ends).astype(dt.dtype)
            equal = diffrax.ConstantStepSize()
            return _diffrax(f, y0, args, method.step, times, dt, equal, min(most, COUNTER - 8) + 8, None)
        states, lost = solve_to(
            f,
            y0,
            dt=dt,
            ends=ends,
            t0=t0,
            args=args,
            step=method.step,
            compensated=method.compensated,
            breaks=options.get("breaks", ()),
        )
        return states, lost, ends[-1]

    return run


def adaptive_program(method: Method, f: VectorField, times: np.ndarray, adjoint: Any = None) -> Program:
    """``run(y0, args, rtol, atol)``: states at the times by the method's own steps; one program for all tolerances.

    Between steps a diffrax solver interpolates; an extrapolated step is looked at t0 and t1 alone.
    """
    options = dict(method.options)
    most = options.get("max_steps", MOST_ADAPTIVE_STEPS)

    def run(y0, args, rtol, atol):
        if is_diffrax(method.step):
            import diffrax

            make = options.get("controller", lambda rtol, atol: diffrax.PIDController(rtol=rtol, atol=atol))
            moments = jnp.asarray(times, trees.time_dtype(y0))
            return _diffrax(f, y0, args, method.step, moments, options.get("dt0"), make(rtol, atol), most, adjoint)
        run = solve_adaptive(
            f,
            y0,
            t0=times[0],
            t1=times[-1],
            args=args,
            step=method.step,
            rtol=rtol,
            atol=atol,
            max_steps=most,
            dt0=options.get("dt0"),
            breaks=options.get("breaks", ()),
        )
        tried = run.num_steps + run.num_rejected
        return run.y, jnp.where(run.finished, -1, tried), tried

    return run


def final_state(
    method: Method, run: FixedRun | AdaptiveRun, f: VectorField, t0: float, t1: float, adjoint: Any
) -> Callable[[PyTree, PyTree], PyTree]:
    """``final(y0, args)``: the state at t1, of a program of its own that has a reverse mode."""
    adjoint = method.options.get("adjoint", adjoint)
    ends = np.array([t0, t1])

    def final(y0, args):
        dtype = trees.time_dtype(y0)
        if isinstance(run, AdaptiveRun):
            tolerances = jnp.asarray(run.rtol, dtype), jnp.asarray(run.atol, dtype)
            states = adaptive_program(method, f, ends, adjoint)(y0, args, *tolerances)[0]
        elif is_diffrax(method.step):
            import diffrax

            dt, equal = jnp.asarray(run.dt, dtype), diffrax.ConstantStepSize()
            times = jnp.asarray(ends, dtype)
            states = _diffrax(f, y0, args, method.step, times, dt, equal, run.num_steps + 8, adjoint)[0]
        else:
            states = solve(
                f,
                y0,
                dt=run.dt,
                num_steps=run.num_steps,
                t0=t0,
                args=args,
                step=method.step,
                save_every=run.num_steps,
                compensated=method.compensated,
                checkpoint=method.options.get("checkpoint"),
                breaks=method.options.get("breaks", ()),
            ).y
        return jax.tree.map(lambda leaf: leaf[-1], states)

    return final


def _diffrax(f, y0, args, solver, times, dt0, controller, most, adjoint):
    import diffrax

    options = {"saveat": diffrax.SaveAt(ts=times)} | ({} if adjoint is None else {"adjoint": adjoint})
    dt0 = None if dt0 is None else jnp.asarray(dt0, times.dtype)
    return by_diffrax(f, y0, args, solver, times[0], times[-1], dt0, controller, most, **options)


def by_diffrax(
    f: VectorField,
    y0: PyTree,
    args: PyTree,
    solver: Any,
    t0: jax.Array,
    t1: jax.Array,
    dt0: jax.Array | None,
    controller: Any,
    most: int | None,
    **options: Any,
) -> tuple[PyTree, jax.Array, jax.Array]:
    """A run of a diffrax solver: states with a leading axis, the last one alone where options ask for no other.

    After these: -1, or the steps after which it failed; and the steps taken.
    """
    import diffrax

    term = diffrax.ODETerm(f)
    run = diffrax.diffeqsolve(
        term, solver, t0, t1, dt0, y0, args, stepsize_controller=controller, max_steps=most, throw=False, **options
    )
    failed = jnp.where(run.result == diffrax.RESULTS.successful, -1, run.stats["num_steps"])
    return run.ys, failed, run.stats["num_steps"]
