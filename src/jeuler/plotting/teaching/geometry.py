"""The errors of a step as geometry: a tangent that leaves its curve, a polygon that changes from curve to curve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.plotting.accuracy import axes_or_new, label_ends
from jeuler.plotting.teaching.curves import EXACT, POINTS
from jeuler.solving._scan import solve
from jeuler.steps.explicit import Step, VectorField, euler_step, rk4_step


def tangent_step(
    f: VectorField,
    *,
    t0: float,
    dt: float,
    exact: Callable[[Any], Any],
    args: Any = None,
    step: Step = euler_step,
    ax: Any = None,
) -> Any:
    """One step beside the curve that it starts on: the tangent leaves the curve by the error of the step.

        y(t0 + dt) - (y(t0) + dt f(t0, y(t0))) = dt^2 y''(tau) / 2,   t0 < tau < t0 + dt

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      t0: where the step starts, on the curve, s.
      dt: its size, s.
      exact: the curve, a function of t.
      args: passed to f.
      step: the method; its chord is drawn, the tangent for `euler_step`.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if dt is not positive.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting.teaching import tangent_step
      >>> ax = tangent_step(lambda t, y, args: y, t0=0.0, dt=1.0, exact=np.exp)
      >>> ax.lines[1].get_ydata().tolist(), ax.lines[2].get_ydata().round(3).tolist()
      ([1.0, 2.0], [2.0, 2.718])

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.3.
    """
    checks.positive("dt", dt, "s")
    start, there = float(np.asarray(exact(t0))), float(np.asarray(exact(t0 + dt)))
    end = float(step(f, jnp.asarray(t0, float), jnp.asarray(start), jnp.asarray(dt, float), args))
    ax = axes_or_new(ax)
    t = np.linspace(t0 - 0.4 * dt, t0 + 1.25 * dt, POINTS)
    ax.plot(t, exact(t), **EXACT)
    ax.plot([t0, t0 + dt], [start, end], "o-", color="C3", markersize=4, linewidth=1.2)
    ax.plot([t0 + dt] * 2, [end, there], color="C0", linewidth=2.2)
    bottom = min(float(np.min(exact(t))), end)
    ax.vlines([t0, t0 + dt], bottom, [start, min(end, there)], color="0.7", linewidth=0.8, linestyle=":")
    ax.set(xlabel="t", ylabel="y", title=f"one step of dt = {dt:.3g}")
    labels = [(t[-1], float(np.asarray(exact(t[-1]))), "exact", "0.2"), (t0 + dt, end, "step", "C3")]
    label_ends(ax, [*labels, (t0 + dt, (end + there) / 2, f"error {there - end:.2g}", "C0")])
    return ax


def neighbouring_curves(
    f: VectorField,
    y0: float,
    *,
    t0: float,
    t1: float,
    num_steps: int,
    args: Any = None,
    step: Step = euler_step,
    ax: Any = None,
) -> Any:
    """The polygon of the steps on the solution curves through its corners: each step ends on a neighbouring curve.

        y_{n+1} = step(y_n) lies on the curve of another initial value; at t1 the curves are as far apart as the errors
        of all steps, each carried on by the equation

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial value.
      t0: first time, s.
      t1: last time, s.
      num_steps: number of steps.
      args: passed to f.
      step: the method.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes: the curve from (t0, y0), those through the corners, each over the whole interval, the polygon.
    Raises: ValueError, if num_steps is not a number of steps.
    Example:
      >>> from jeuler.plotting.teaching import neighbouring_curves
      >>> ax = neighbouring_curves(lambda t, y, args: y, 1.0, t0=0.0, t1=1.0, num_steps=2)
      >>> [round(float(line.get_ydata()[-1]), 3) for line in ax.lines]  # e, 1.5 exp(1/2), 2.25
      [2.718, 2.473, 2.25, 2.25]

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. I.7 and II.3
      (Lady Windermere's fan).
    """
    dt = (t1 - t0) / checks.count("num_steps", num_steps, least=1)
    run = solve(f, float(y0), dt=dt, num_steps=num_steps, t0=t0, args=args, step=step)
    corners, y = np.asarray(run.t), np.asarray(run.y)
    ax = axes_or_new(ax)
    for n, (corner, value) in enumerate(zip(corners, y, strict=True)):
        t, curve = _through(f, float(corner), float(value), t0, t1, dt, n, num_steps, args)
        ax.plot(t, curve, **(EXACT if n == 0 else {"color": "0.7", "linewidth": 1.0}))
    ax.plot(corners, y, "o-", color="C3", markersize=4, linewidth=1.2)
    ax.set(xlabel="t", ylabel="y", title=f"{num_steps} steps of dt = {dt:.3g}")
    exact = ax.lines[0].get_ydata()[-1]
    label_ends(ax, [(t1, float(exact), "exact", "0.2"), (t1, float(y[-1]), "steps", "C3")])
    return ax


def _through(
    f: VectorField, t: float, y: float, t0: float, t1: float, dt: float, before: int, steps: int, args: Any
) -> tuple[np.ndarray, np.ndarray]:
    """The solution curve through (t, y), over the whole interval, by small steps of `rk4_step` both ways."""
    fine = 20  # of these in a step
    parts = [
        solve(f, y, dt=sign * dt / fine, num_steps=fine * count, t0=t, args=args, step=rk4_step)
        for sign, count in ((-1, before), (1, steps - before))
    ]
    back, on = parts
    return (
        np.concatenate([np.asarray(back.t)[:0:-1], np.asarray(on.t)]),
        np.concatenate([np.asarray(back.y)[:0:-1], np.asarray(on.y)]),
    )
