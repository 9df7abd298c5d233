"""Errors: of one step and of all so far, and at the end against the step size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.precision import precision
from jeuler.plotting.accuracy import axes_or_new, label_ends
from jeuler.solving._scan import solve
from jeuler.steps.explicit import Step, VectorField, euler_step


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

        local_n = |step(y(t_{n-1})) - y(t_n)|,   cumulative_n = |y_n - y(t_n)|

    Args:
      f: scalar vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial value.
      t0: first time, s.
      t1: last time, s.
      num_steps: number of steps.
      exact: the exact solution, a function of t.
      args: passed to f.
      step: the method.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if num_steps is not a number of steps, or t1 is not later than t0.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import local_and_cumulative_error
      >>> ax = local_and_cumulative_error(
      ...     lambda t, y, args: 2 * t, 0.0, t0=0.0, t1=1.0, num_steps=4, exact=lambda t: t**2)
      >>> for line in ax.lines:
      ...     print(line.get_ydata().tolist())
      [0.0625, 0.125, 0.1875, 0.25]
      [0.0625, 0.0625, 0.0625, 0.0625]

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.3.
    """
    dt = (t1 - t0) / checks.count("num_steps", num_steps, least=1)
    run = solve(f, float(y0), dt=dt, num_steps=num_steps, t0=t0, args=args, step=step)
    t = np.asarray(run.t)
    truth = jnp.asarray(exact(t))
    one_step = jax.vmap(lambda t, y: step(f, t, y, dt, args))(run.t[:-1], truth[:-1])
    errors = {"cumulative: all steps so far": run.y[1:] - truth[1:], "local: one step": one_step - truth[1:]}
    ax, labels = axes_or_new(ax), []
    for (name, error), colour in zip(errors.items(), ("C3", "C0"), strict=True):
        ax.semilogy(t[1:], np.abs(error), "o-", color=colour, markersize=3)
        labels.append((t[-1], abs(float(error[-1])), name, colour))
    ax.set(xlabel="t", ylabel="error", title=f"dt = {dt:.3g}")
    label_ends(ax, labels)
    return ax


def error_against_dt(
    f: VectorField,
    y0: Any,
    *,
    t0: float,
    t1: float,
    num_steps: Sequence[int],
    exact: Callable[[Any], Any],
    args: Any = None,
    steps: Mapping[str, Step] | None = None,
    dtype: Any = jnp.float32,
    compensated: bool = True,
    ax: Any = None,
) -> Any:
    """Error at t1 against dt until roundoff turns it up again; dashed, the same with compensated sums.

        error = C dt^p + roundoff,  roundoff growing with the number of steps

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial value, a number or an array.
      t0: first time, s.
      t1: last time, s.
      num_steps: how many steps, one run each.
      exact: the exact solution, a function of t.
      args: passed to f.
      steps: {name: step}; None takes Euler.
      dtype: precision of the runs.
      compensated: draw the compensated runs too, of the steps that have them.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if a number of steps is not one, or t1 is not later than t0.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import error_against_dt
      >>> ax = error_against_dt(lambda t, y, args: -y, 1.0, t0=0.0, t1=1.0, num_steps=[10, 100, 1000],
      ...     exact=lambda t: np.exp(-t), compensated=False)
      >>> [round(float(error), 5) for error in ax.lines[0].get_ydata()]
      [0.0192, 0.00185, 0.00018]

    Source: P. Henrici, Discrete Variable Methods in Ordinary Differential Equations, 1962, sect. 1.4.
    """
    counts = [checks.count("num_steps", n, least=1) for n in num_steps]
    dts = [(t1 - t0) / n for n in counts]
    ax, labels = axes_or_new(ax), []

    def error(step: Step, n: int, sums: bool) -> float:
        with precision(dtype):
            start = jnp.asarray(y0, dtype)
            run = solve(
                f, start, dt=(t1 - t0) / n, num_steps=n, t0=t0, args=args, step=step, save_every=n, compensated=sums
            )
        return float(np.linalg.norm(np.asarray(run.y[-1], float) - exact(t1)))

    for index, (name, step) in enumerate((steps or {"Euler": euler_step}).items()):
        for sums, style in ((False, "-"), (True, "--")):
            if sums and not (compensated and hasattr(step, "increment")):
                continue
            errors = [error(step, n, sums) for n in counts]
            ax.loglog(dts, errors, style, marker="o", markersize=3, color=f"C{index}")
            labels.append((dts[-1], errors[-1], f"{name}, compensated" if sums else name, f"C{index}"))
    ax.axhline(np.finfo(dtype).eps, color="0.7", linewidth=0.8, linestyle=":")
    ax.text(max(dts), np.finfo(dtype).eps, "eps", color="0.5", fontsize=8, va="bottom")
    ax.invert_xaxis()
    ax.set(xlabel="dt", ylabel="error at the end", title=f"{np.dtype(dtype)}")
    label_ends(ax, labels)
    return ax
