"""Solution curves: through a field of slopes, as the polygon of the steps, with several step sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.plotting.accuracy import axes_or_new, label_ends
from jeuler.solving._scan import solve
from jeuler.steps.explicit import Step, VectorField, euler_step, rk4_step

EXACT: dict[str, Any] = {"color": "0.2", "linewidth": 1.6}
POINTS = 501  # of a curve drawn from a function
LINE: dict[str, Any] = {
    "headwidth": 0,
    "headlength": 0,
    "headaxislength": 0,
    "width": 0.002,
    "pivot": "mid",
    "color": "0.75",
}


def slope_field(
    f: VectorField,
    t: tuple[float, float],
    y: tuple[float, float],
    *,
    solutions: Sequence[Any] | Mapping[str, Any] = (),
    args: Any = None,
    dt: float | None = None,
    num: int = 24,
    ax: Any = None,
) -> Any:
    """Short lines of slope f(t, y) over a rectangle of the plane, and solution curves through it.

        y' = f(t, y, args):  a solution runs along the lines

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      t: first and last time, s.
      y: lowest and highest state shown.
      solutions: curves to draw: exact ones as functions y(t), or initial values at t[0], which `rk4_step`
        carries on; or a dictionary {label: curve}.
      args: passed to f.
      dt: step of the curves carried on, s; None takes a thousandth of the interval.
      num: lines along each side.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if dt is not positive or num is below 2.
    Example:
      >>> from jeuler.plotting import slope_field
      >>> ax = slope_field(lambda x, y, args: -y, (0.0, 2.0), (0.0, 1.0), solutions={"y(0) = 1": 1.0})
      >>> [text.get_text() for text in ax.texts], round(float(ax.lines[0].get_ydata()[-1]), 4)
      (['y(0) = 1'], 0.1353)

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. I.1.
    """
    num = checks.count("num", num, least=2)
    dt = (t[1] - t[0]) / 1000 if dt is None else dt
    checks.positive("dt", dt, "s")
    ax = axes_or_new(ax)
    times, states = (grid.ravel() for grid in np.meshgrid(np.linspace(*t, num), np.linspace(*y, num), indexing="ij"))
    slopes = np.asarray(jax.vmap(lambda t, y: f(t, y, args))(jnp.asarray(times), jnp.asarray(states)))
    slopes = slopes * (t[1] - t[0]) / (y[1] - y[0])  # on the page, so that all lines are as long
    across = 1 / np.hypot(1, slopes)
    ax.quiver(times, states, across, across * slopes, angles="uv", scale=1.5 * num, **LINE)
    named = solutions if isinstance(solutions, Mapping) else dict(enumerate(solutions))
    labels = []
    for index, (name, curve) in enumerate(named.items()):
        if callable(curve):
            x = np.linspace(*t, POINTS)
            values = np.asarray(curve(x))
        else:
            num_steps = round((t[1] - t[0]) / dt)
            run = solve(f, float(curve), dt=dt, num_steps=num_steps, t0=t[0], args=args, step=rk4_step)
            x, values = np.asarray(run.t), np.asarray(run.y)
        ax.plot(x, values, color=f"C{index}")
        inside = np.flatnonzero((values >= y[0]) & (values <= y[1]))
        if isinstance(name, str) and inside.size:
            labels.append((x[inside[-1]], values[inside[-1]], name, f"C{index}"))
    ax.set(xlim=t, ylim=y, xlabel="t", ylabel="y")
    label_ends(ax, labels)
    return ax


def euler_polygon(
    f: VectorField,
    y0: float,
    *,
    t0: float,
    t1: float,
    num_steps: int,
    exact: Callable[[Any], Any],
    args: Any = None,
    step: Step = euler_step,
    ax: Any = None,
) -> Any:
    """The polygon of the steps over the exact solution, and how far each corner is off it.

        y_{n+1} = y_n + dt f(t_n, y_n, args)    each side leaves with the slope at its left end

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial value.
      t0: first time, s.
      t1: last time, s.
      num_steps: corners after the first.
      exact: the exact solution, a function of t.
      args: passed to f.
      step: the method.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if num_steps is not a number of steps, or t1 is not later than t0.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import euler_polygon
      >>> ax = euler_polygon(lambda t, y, args: -y, 1.0, t0=0.0, t1=1.0, num_steps=2, exact=lambda t: np.exp(-t))
      >>> ax.lines[1].get_ydata().tolist()
      [1.0, 0.5, 0.25]

    Source: L. Euler, Institutionum calculi integralis I, 1768, sect. 650 (the method); E. Hairer, S. Norsett, G.
      Wanner, Solving Ordinary Differential Equations I, 1993, sect. I.7 (Euler polygons).
    """
    dt = (t1 - t0) / checks.count("num_steps", num_steps, least=1)
    run = solve(f, float(y0), dt=dt, num_steps=num_steps, t0=t0, args=args, step=step)
    ax = axes_or_new(ax)
    x = np.linspace(t0, t1, POINTS)
    ax.plot(x, exact(x), **EXACT)
    t, y = np.asarray(run.t), np.asarray(run.y)
    ax.plot(t, y, "o-", color="C3", markersize=4, linewidth=1.2)
    ax.vlines(t[1:], y[1:], np.asarray(exact(t[1:])), color="C3", linewidth=0.8, linestyle=":")
    ax.set(xlabel="t", ylabel="y", title=f"{num_steps} steps of dt = {dt:.3g}")
    label_ends(ax, [(t[-1], float(exact(t[-1])), "exact", "0.2"), (t[-1], y[-1], "steps", "C3")])
    return ax


def step_sizes(
    f: VectorField,
    y0: float,
    *,
    t0: float,
    t1: float,
    dts: Sequence[float],
    exact: Callable[[Any], Any],
    args: Any = None,
    step: Step = euler_step,
    ax: Any = None,
) -> Any:
    """Runs of several step sizes beside the exact solution.

        |y_n - y(t_n)| <= C dt^p,  p the order of the step

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial value.
      t0: first time, s.
      t1: last time, s.
      dts: step sizes, s, each of which divides t1 - t0.
      exact: the exact solution, a function of t.
      args: passed to f.
      step: the method.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if a step size does not divide t1 - t0.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import step_sizes
      >>> ax = step_sizes(lambda t, y, args: -y, 1.0, t0=0.0, t1=1.0, dts=[0.5, 0.25], exact=lambda t: np.exp(-t))
      >>> [round(float(line.get_ydata()[-1]), 4) for line in ax.lines]
      [0.3679, 0.25, 0.3164]

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. I.7.
    """
    counts = [round((t1 - t0) / dt) if dt > 0 else 0 for dt in dts]
    for dt, num_steps in zip(dts, counts, strict=True):
        if num_steps < 1 or abs(num_steps * dt - (t1 - t0)) > 1e-6 * abs(t1 - t0):
            raise ValueError(f"each of dts must divide t1 - t0 = {t1 - t0:g} s, got {dt!r}; take (t1 - t0) / n")
    ax = axes_or_new(ax)
    x = np.linspace(t0, t1, POINTS)
    ax.plot(x, exact(x), **EXACT)
    labels = [(t1, float(exact(t1)), "exact", "0.2")]
    for index, (dt, num_steps) in enumerate(zip(dts, counts, strict=True)):
        run = solve(f, float(y0), dt=dt, num_steps=num_steps, t0=t0, args=args, step=step)
        ax.plot(run.t, run.y, "o-" if num_steps <= 40 else "-", color=f"C{index}", markersize=3, linewidth=1.1)
        labels.append((t1, float(run.y[-1]), f"dt = {dt:g}", f"C{index}"))
    ax.set(xlabel="t", ylabel="y")
    label_ends(ax, labels)
    return ax
