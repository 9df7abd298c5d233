"""Figures that explain step-by-step integration: fields and curves, steps and errors, stability."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jeuler._precision import double_precision, precision
from jeuler.methods import Step, VectorField, euler_step
from jeuler.plotting.accuracy import label_ends
from jeuler.solve import solve
from jeuler.stability import amplification

EXACT = {"color": "0.2", "linewidth": 1.6}


def slope_field(
    f: VectorField,
    t: tuple[float, float],
    y: tuple[float, float],
    *,
    solutions: Sequence[Any] = (),
    args: Any = None,
    dt: float | None = None,
    num: int = 24,
    ax: Any = None,
) -> Any:
    """Short lines of slope f(t, y) over a rectangle of the plane, and solution curves through it.

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
    """
    from jeuler.methods import rk4_step

    ax = _axes(ax)
    times, states = np.meshgrid(np.linspace(*t, num), np.linspace(*y, num), indexing="ij")
    slopes = np.asarray(jax.vmap(lambda t, y: f(t, y, args))(jnp.asarray(times.ravel()), jnp.asarray(states.ravel())))
    aspect = (t[1] - t[0]) / (y[1] - y[0])  # lines of equal length on the page
    across = 1 / np.hypot(1, slopes.reshape(times.shape) * aspect)
    ax.quiver(
        times,
        states,
        across,
        across * slopes.reshape(times.shape) * aspect,
        color="0.75",
        pivot="mid",
        angles="uv",
        headwidth=0,
        headlength=0,
        headaxislength=0,
        scale=1.5 * num,
        width=0.002,
    )
    named = solutions if isinstance(solutions, dict) else dict.fromkeys(())
    curves = list(solutions.values()) if isinstance(solutions, dict) else list(solutions)
    names = list(named) or [""] * len(curves)
    labels = []
    for index, (name, curve) in enumerate(zip(names, curves, strict=True)):
        if callable(curve):
            x = np.linspace(*t, 501)
            values = np.asarray(curve(x))
        else:
            size = dt or (t[1] - t[0]) / 1000
            run = solve(
                f,
                float(curve),
                dt=size,
                num_steps=round((t[1] - t[0]) / size),
                t0=t[0],
                args=args,
                step=rk4_step,
            )
            x, values = np.asarray(run.t), np.asarray(run.y)
        (line,) = ax.plot(x, values, color=f"C{index}")
        inside = np.flatnonzero((values >= y[0]) & (values <= y[1]))
        if name and inside.size:
            labels.append((x[inside[-1]], values[inside[-1]], name, line.get_color()))
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
    """The polygon of the steps over the exact solution, with the slope at which each step leaves.

    Args:
      f: scalar vector field. y0: initial value. t0, t1: first and last time, s. num_steps: corners after the
        first.
      exact: the exact solution, a function of t. args: passed to f. step: the method.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    """
    ax = _axes(ax)
    run = solve(f, float(y0), dt=(t1 - t0) / num_steps, num_steps=num_steps, t0=t0, args=args, step=step)
    x = np.linspace(t0, t1, 501)
    ax.plot(x, exact(x), **EXACT)
    t, y = np.asarray(run.t), np.asarray(run.y)
    ax.plot(t, y, "o-", color="C3", markersize=4, linewidth=1.2)
    ax.vlines(t[1:], y[1:], np.asarray(exact(t[1:])), color="C3", linewidth=0.8, linestyle=":")
    ax.set(xlabel="t", ylabel="y", title=f"{num_steps} steps of dt = {(t1 - t0) / num_steps:.3g}")
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

    Args: as `euler_polygon`; dts: step sizes, s, each to divide t1 - t0.
    Returns: the axes.
    """
    ax = _axes(ax)
    x = np.linspace(t0, t1, 501)
    ax.plot(x, exact(x), **EXACT)
    labels = [(t1, float(exact(t1)), "exact", "0.2")]
    for index, dt in enumerate(dts):
        num_steps = round((t1 - t0) / dt)
        run = solve(f, float(y0), dt=(t1 - t0) / num_steps, num_steps=num_steps, t0=t0, args=args, step=step)
        marker = "o-" if num_steps <= 40 else "-"
        ax.plot(run.t, run.y, marker, color=f"C{index}", markersize=3, linewidth=1.1)
        labels.append((t1, float(run.y[-1]), f"dt = {dt:g}", f"C{index}"))
    ax.set(xlabel="t", ylabel="y")
    label_ends(ax, labels)
    return ax


def local_and_cumulative_error(
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
    """The error made in each step, started from the exact solution, and the error after all steps so far.

    Args: as `euler_polygon`.
    Returns: the axes.
    """
    ax = _axes(ax)
    dt = (t1 - t0) / num_steps
    run = solve(f, float(y0), dt=dt, num_steps=num_steps, t0=t0, args=args, step=step)
    t = np.asarray(run.t)
    truth = jnp.asarray(exact(t))
    one_step = jax.vmap(lambda t, y: step(f, t, y, dt, args))(run.t[:-1], truth[:-1])
    local, cumulative = np.abs(one_step - truth[1:]), np.abs(run.y - truth)
    ax.semilogy(t[1:], cumulative[1:], "o-", color="C3", markersize=3)
    ax.semilogy(t[1:], local, "o-", color="C0", markersize=3)
    ax.set(xlabel="t", ylabel="error", title=f"dt = {dt:.3g}")
    labels = [
        (t[-1], cumulative[-1], "cumulative: all steps so far", "C3"),
        (t[-1], local[-1], "local: one step", "C0"),
    ]
    label_ends(ax, labels)
    return ax


def error_against_dt(
    f: VectorField,
    y0: Any,
    *,
    t0: float,
    t1: float,
    num_steps: Sequence[int],
    exact: Any,
    args: Any = None,
    steps: dict[str, Step] | None = None,
    dtype: Any = jnp.float32,
    compensated: bool = True,
    ax: Any = None,
) -> Any:
    """Error at t1 against dt until roundoff turns it up again; dashed, the same with compensated sums.

    Args:
      f: vector field. y0: initial value. t0, t1: first and last time, s.
      num_steps: how many steps, one run each.
      exact: the exact solution, a function of t.
      args: passed to f. steps: {name: step}; None takes Euler. dtype: precision of the runs.
      compensated: draw the compensated runs too, of the steps that have them.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    """
    ax = _axes(ax)
    labels = []
    for index, (name, step) in enumerate((steps or {"Euler": euler_step}).items()):
        for sums, style in ((False, "-"), (True, "--")):
            if sums and not (compensated and hasattr(step, "increment")):
                continue
            dt, error = [], []
            for n in num_steps:
                with precision(dtype):
                    run = solve(
                        f,
                        jnp.asarray(y0, dtype),
                        dt=(t1 - t0) / n,
                        num_steps=n,
                        t0=t0,
                        args=args,
                        step=step,
                        save_every=n,
                        compensated=sums,
                    )
                dt.append((t1 - t0) / n)
                error.append(float(np.linalg.norm(np.asarray(run.y[-1], float) - exact(t1))))
            ax.loglog(dt, error, style, marker="o", markersize=3, color=f"C{index}")
            labels.append((dt[-1], error[-1], f"{name}, compensated" if sums else name, f"C{index}"))
    ax.axhline(np.finfo(dtype).eps, color="0.7", linewidth=0.8, linestyle=":")
    ax.text(max(dt), np.finfo(dtype).eps, "eps", color="0.5", fontsize=8, va="bottom")
    ax.invert_xaxis()
    ax.set(xlabel="dt", ylabel="error at the end", title=f"{np.dtype(dtype)}")
    label_ends(ax, labels)
    return ax


def stability_regions(
    steps: dict[str, Step],
    *,
    eigenvalues: Any = None,
    dt: float = 1.0,
    box: tuple[float, float, float, float] = (-4.5, 1.5, -3.5, 3.5),
    ax: Any = None,
) -> Any:
    """Where |R(z)| <= 1 in the complex plane, z = dt lambda, and the eigenvalues of a problem times dt on
    top.

    Args:
      steps: {name: step}, methods without separate treatment of position and velocity.
      eigenvalues: complex numbers lambda, 1/s; None draws the regions alone.
      dt: step size, s.
      box: smallest and largest real part, smallest and largest imaginary part.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    """
    ax = _axes(ax, size=(6.5, 6))
    x, y = np.linspace(box[0], box[1], 241), np.linspace(box[2], box[3], 281)
    z = x[:, None] + 1j * y
    ax.axhline(0, color="0.8", linewidth=0.8)
    ax.axvline(0, color="0.8", linewidth=0.8)
    labels = []
    for index, (name, step) in enumerate(steps.items()):
        with double_precision():
            gain = jax.jit(jax.vmap(functools.partial(amplification, step)))(jnp.asarray(z.ravel()))
        gain = np.asarray(gain).reshape(z.shape)
        ax.contour(x, y, gain.T, levels=[1.0], colors=f"C{index}", linewidths=1.4)
        ax.contourf(x, y, gain.T, levels=[0.0, 1.0], colors=f"C{index}", alpha=0.06)
        stable = np.argwhere((gain <= 1) & (z.imag >= 0))
        if stable.size:
            at = z[tuple(stable[np.argmax(z.imag[tuple(stable.T)])])]
            labels.append((at.real, at.imag, name, f"C{index}"))
    if eigenvalues is not None:
        points = dt * np.asarray(eigenvalues)
        ax.plot(points.real, points.imag, "k.", markersize=5)
        ax.set_title(f"dots: eigenvalues times dt = {dt:g}", fontsize=9)
    ax.set(xlabel="Re dt λ", ylabel="Im dt λ", aspect="equal", xlim=box[:2], ylim=box[2:])
    label_ends(ax, labels)
    return ax


def _axes(ax: Any, size: tuple[float, float] = (7, 4.2)) -> Any:
    """The axes given, or those of a new figure."""
    if ax is None:
        _, ax = plt.subplots(figsize=size, layout="constrained")
    ax.spines[["top", "right"]].set_visible(False)
    return ax
