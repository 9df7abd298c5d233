"""Steps sized by their own error estimate, in a bounded loop that has a reverse mode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import Function, component
from jeuler._core.partition import arrays_only
from jeuler._jax import programs
from jeuler.solving._breaks import between, checked_breaks, told_apart
from jeuler.solving._tables import adaptive_table
from jeuler.steps.embedded import tsit5
from jeuler.steps.explicit import VectorField
from jeuler.steps.extrapolated import ExtrapolatedStep

PyTree = Any
STRICT = 0.1  # the part of the error otherwise allowed that is allowed to a step after a rejected one


@component()
class AdaptiveSolution:
    """What an adaptive run gives back.

    Attributes:
      t: the times asked for, the initial time first, shape (saved,), s.
      y: the states at these times: a pytree with leading axis saved.
      num_steps: accepted steps, int32 scalar.
      num_rejected: steps tried again with a smaller dt, int32 scalar.
      error: sum of the estimated errors of the accepted steps, of the structure of y: what the run knows of its own
        error, before the equation damps or amplifies it; its derivative is 0.
      finished: whether the last time was reached within max_steps; if not, the states from there on are NaN.
      longest_gap: the longest time between two looks at f in the accepted steps, s. What f does in between for less
        than that may have left no trace in states and error.
    Example:
      >>> import jeuler
      >>> run = jeuler.solve_adaptive(lambda t, y, args: -y, 1.0, t1=1.0, max_steps=2, dt0=0.1)
      >>> run.t.tolist(), run.y.tolist(), int(run.num_steps), bool(run.finished)
      ([0.0, 1.0], [1.0, nan], 2, False)
    """

    t: Array
    y: PyTree
    num_steps: Array
    num_rejected: Array
    error: PyTree
    finished: Array
    longest_gap: Array

    _repr_html_ = adaptive_table


@says_what_to_write(dt="dt0=..., the first step to try", num_steps="t1=...", save_every="t1=[...], where to stop")
def solve_adaptive(
    f: VectorField,
    y0: PyTree,
    *,
    t1: Any,
    t0: Any = 0.0,
    args: Any = None,
    step: ExtrapolatedStep | None = None,
    rtol: float = 1e-6,
    atol: float = 1e-9,
    dt0: Any = None,
    max_dt: Any = None,
    max_steps: int = 16_384,
    breaks: Any = (),
) -> AdaptiveSolution:
    """Advance y' = f(t, y, args) to given times, each step sized so that its estimated error is within tolerance.

        e = rms(error / (atol + rtol max(|y|, |y_next|)));   accept if e <= c
        dt <- dt min(5, max(0.2, 0.9 (e / c)^(-1/k))),   k the order of the step

    c is 0.1 for the method of Tsitouras, as errors of the steps add up, and 1 for the others; a tenth of that for the
    step after a rejected one: f may jump there. The new dt is for the c of the next step.

    Every step sees f at its end, and the method of Tsitouras also at 0.16, 0.33, 0.6 and 0.9 of it, so that a jump
    shows in the error. Not seen is what lasts for less than 0.3 of a step and lies between these times, such as a short
    push: the run is then that without it, and its error says nothing of it. `AdaptiveSolution.longest_gap` says how
    long that may be. With ``max_dt`` no gap is longer than 0.3 max_dt; times that are known belong into ``breaks``.

    A bounded loop: nested scans whose unused parts are skipped, so jit, vmap, jacfwd and reverse-mode grad work (each
    block is computed again on the way back). The derivative is that of the steps taken; their sizes count as given.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial state, any pytree of floating or complex arrays. Differentiable.
      t1: the final time, or increasing times (time,) to stop at, s, none before t0; t0 itself gives y0. Where t1 is
        traced and earlier, every state is NaN.
      t0: initial time, s.
      args: passed to f. Differentiable.
      step: an `extrapolated_euler` step of order 2 or more; None takes the method of Tsitouras of order 5, with the
        coefficients of ``diffrax.Tsit5``.
      rtol: error allowed in a step, relative to the state.
      atol: error allowed in a step, in units of the state.
      dt0: first step to try, s; None guesses from the size of y0 and its slope.
      max_dt: longest step to take, s; None sets no bound.
      max_steps: most steps, rejected ones included, from one of the times or breaks to the next.
      breaks: times at which f may jump, (break,), s: a step ends there, f is evaluated just before the end of it and
        just after the start of the next. Differentiable, by each time that no other break has too: there the derivative
        is NaN.
    Returns: `AdaptiveSolution`.
    Raises: ValueError, before tracing, naming the argument, what was expected and what came.
    Example:
      >>> import jeuler
      >>> run = jeuler.solve_adaptive(lambda t, y, args: -y, 1.0, t1=[1.0, 2.0])
      >>> [round(float(y), 5) for y in run.y], bool(run.finished)
      ([1.0, 0.36788, 0.13534], True)

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.4 and II.9.
    """
    chosen: Any = tsit5() if step is None else step
    if not hasattr(chosen, "attempt") or chosen.order < 2:
        raise ValueError(f"step must be an extrapolated_euler step of order 2 or more, got {step!r}")
    y0 = checks.state("y0", y0)
    checks.number("t0", t0)
    max_steps = checks.count("max_steps", max_steps, least=1)
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        checks.number(name, tolerance)
        if not checks.is_traced(tolerance) and float(tolerance) < 0:
            raise ValueError(f"{name} must be at least 0, got {tolerance!r}")
    dtype = trees.time_dtype(y0)
    times = jnp.atleast_1d(jnp.asarray(checks.reals("t1", t1, "a time, or increasing times, s", dtype), dtype))
    if times.ndim > 1 or not times.size:
        raise ValueError(f"t1 must be a time, or times of shape (time,), s, got shape {times.shape}")
    if not checks.is_traced(times):
        checks.finite("t1", times if times.size > 1 else times[0])
    t0 = jnp.asarray(t0, times.dtype)
    if not checks.is_traced(times) and not checks.is_traced(t0) and not _in_order(t0, times):
        raise ValueError(
            f"t1 must not be before t0={float(t0)}, and must increase, got {np.asarray(times).tolist()}; backwards in "
            f"time goes solve with a negative dt"
        )
    for name, size in (("dt0", dt0), ("max_dt", max_dt)):
        if size is not None:
            checks.positive(name, size, "s")
    f, args = arrays_only(f, args)
    known = checked_breaks(breaks, times.dtype)
    inputs = Function(f), y0, args, times, t0, dt0, max_dt, rtol, atol, known, Function(chosen)
    return programs.call(_solve_adaptive, inputs, (max_steps,))


def _solve_adaptive(
    field: Function,
    y0: PyTree,
    args: PyTree,
    times: Array,
    t0: Array,
    dt0: Any,
    max_dt: Any,
    rtol: Any,
    atol: Any,
    breaks: Array,
    stepper: Function,
    max_steps: int,
) -> AdaptiveSolution:
    """`solve_adaptive`, as it is compiled."""
    f, step = field.function, stepper.function
    checks.vector_field(f, t0, y0, args)
    times = jnp.where(_in_order(t0, times) & ~jnp.any(jnp.isnan(breaks)), times, jnp.nan)
    breaks = told_apart(breaks, t0, times[-1])
    if dt0 is None:
        dt0 = first_step(y0, f(t0, y0, args), times[-1] - t0)
    if max_dt is not None:
        max_dt = lax.stop_gradient(jnp.asarray(max_dt, times.dtype))
        dt0 = jnp.minimum(dt0, max_dt)

    stops = jnp.concatenate([times, jnp.clip(breaks, t0, times[-1])])
    order = jnp.argsort(stops)
    asked = jnp.argsort(order)[: times.size]  # where the times are among the stops
    stops = stops[order]

    def to_time(at: _Progress, ends: tuple[Array, Array]) -> tuple[_Progress, tuple[PyTree, Array]]:
        begin, end = ends
        here = between(f, breaks, begin, end) if breaks.size else f
        if breaks.size:
            at = at._replace(taken_over=step.start(here, begin, at.y, args))
        at = at._replace(failed=jnp.asarray(False))
        most = at.tried + max_steps
        attempt = lambda at: _try_step(step, here, args, end, at, max_dt, rtol, atol)  # noqa: E731
        going = lambda at: (at.t < end) & (at.tried < most)  # noqa: E731
        at = bounded_while(going, attempt, at, max_steps)
        reached = at.t >= end
        if breaks.size:  # a break at one of the times: nothing moves, but the derivative with respect to it counts
            moved = jax.tree.map(
                lambda y, slope: y + ((end - at.t) * slope).astype(y.dtype), at.y, here(end, at.y, args)
            )
            y = jax.tree.map(lambda a, b: jnp.where(reached, a, b), moved, at.y)
            at = at._replace(t=jnp.where(reached, end, at.t), y=y)
        return at, (jax.tree.map(lambda leaf: jnp.where(reached, leaf, jnp.nan), at.y), reached)

    none, no_error = jnp.int32(0), jax.tree.map(jnp.zeros_like, y0)
    taken_over, dt0 = step.start(f, t0, y0, args), jnp.asarray(dt0, times.dtype)
    start = _Progress(t0, y0, taken_over, dt0, no_error, none, none, jnp.asarray(False), jnp.zeros((), times.dtype))
    end, (y, reached) = lax.scan(to_time, start, (jnp.append(t0, stops[:-1]), stops))
    y = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[asked]]), y0, y)
    counts, gap = (end.accepted, end.tried - end.accepted), end.longest * getattr(step, "gap", 1.0)
    return AdaptiveSolution(jnp.append(t0, times), y, *counts, end.error, reached[-1], gap)


class _Progress(NamedTuple):
    """What a run carries from one trial step to the next."""

    t: Array
    y: PyTree
    taken_over: PyTree  # from the step before: the slope at its end
    dt: Array  # of the next step to try
    error: PyTree  # sum of the estimated errors
    accepted: Array  # steps
    tried: Array  # steps
    failed: Array  # whether the last step was rejected
    longest: Array  # accepted step, s


def _try_step(
    step: Any, f: VectorField, args: PyTree, end: Array, at: _Progress, max_dt: Any, rtol: Any, atol: Any
) -> _Progress:
    """A step, taken if its error is within tolerance, and the size of the next; not past ``end``."""
    last = at.t + at.dt * (1 + 1e-3) >= end
    h = jnp.where(last, end - at.t, at.dt)
    increment, error, taken_over = step.attempt(f, at.t, at.y, at.taken_over, h, args)
    y = trees.add(at.y, increment)
    error = lax.stop_gradient(error)
    ratio = lax.stop_gradient(error_ratio(error, at.y, y, rtol, atol))
    ratio = ratio / getattr(step, "allowed", 1.0)
    good = ratio <= jnp.where(at.failed, STRICT, 1)
    aimed = jnp.maximum(ratio, 1e-12) / jnp.where(good, 1, STRICT)
    factor = jnp.where(jnp.isfinite(ratio), 0.9 * aimed ** (-1 / step.order), 0.2)
    wanted = lax.stop_gradient(h * jnp.clip(factor, 0.2, 5.0))
    if max_dt is not None:
        wanted = jnp.minimum(wanted, max_dt)
    shortened = good & last  # to stop at a time: no reason for a smaller dt
    take = lambda new, old: jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)  # noqa: E731
    return _Progress(
        t=jnp.where(good, jnp.where(last, end, at.t + h), at.t),
        y=take(y, at.y),
        taken_over=take(taken_over, at.taken_over),
        dt=jnp.where(shortened, jnp.maximum(wanted, at.dt), wanted),
        error=take(trees.add(at.error, error), at.error),
        accepted=at.accepted + good,
        tried=at.tried + 1,
        failed=~good,
        longest=lax.stop_gradient(jnp.where(good, jnp.maximum(at.longest, h), at.longest)),
    )


def _in_order(t0: Array, times: Array) -> Array:
    """Whether the times increase from t0 on; the first may be t0."""
    return (times[0] >= t0) & jnp.all(jnp.diff(times) > 0)


def error_ratio(error: PyTree, y: PyTree, y_next: PyTree, rtol: Any, atol: Any) -> Array:
    """rms(error / (atol + rtol max(|y|, |y_next|))); nothing wrong where both error and allowance are 0."""

    def squares(e, a, b):
        allowed = atol + rtol * jnp.maximum(jnp.abs(a), jnp.abs(b))
        e = jnp.abs(e)
        return jnp.sum(jnp.where(e > 0, e / jnp.where(allowed > 0, allowed, jnp.finfo(e.dtype).tiny), e) ** 2)

    parts = jax.tree.leaves(jax.tree.map(squares, error, y, y_next))
    count = sum(leaf.size for leaf in jax.tree.leaves(y))
    return jnp.sqrt(sum(parts) / max(count, 1))


def first_step(y: PyTree, slope: PyTree, interval: Array) -> Array:
    """A hundredth of the time in which the slope would make the state, within the interval."""
    norm = lambda x: jnp.sqrt(sum(jnp.sum(jnp.abs(leaf) ** 2) for leaf in jax.tree.leaves(x)))  # noqa: E731
    size, speed = norm(y), norm(slope)
    guess = 0.01 * jnp.where(speed > 0, size / jnp.where(speed > 0, speed, 1), interval)
    return lax.stop_gradient(jnp.clip(guess, 1e-6 * interval, interval)).astype(interval.dtype)


def bounded_while(going: Callable, body: Callable, carry: PyTree, most: int, width: int = 16) -> PyTree:
    """``while going(carry): carry = body(carry)``, at most ``most`` times, with a reverse mode.

    A tree of scans of ``width`` branches; a branch that begins after the end is skipped whole, and its states
    are computed again, not kept, on the way back.
    """

    def guarded(work):
        return lambda carry, _: (lax.cond(going(carry), work, lambda c: c, carry), None)

    branch, reach = guarded(body), 1
    while reach < most:
        inner = branch
        branch = guarded(jax.checkpoint(lambda c, inner=inner: lax.scan(inner, c, None, length=width)[0]))
        reach *= width
    return branch(carry, None)[0]
