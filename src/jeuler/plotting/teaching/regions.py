"""Stability regions in the complex plane."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.precision import double_precision
from jeuler.plotting.accuracy import axes_or_new, label_ends
from jeuler.steps.amplification import amplification
from jeuler.steps.explicit import Step


def stability_regions(
    steps: Mapping[str, Step],
    *,
    eigenvalues: Any = None,
    dt: float = 1.0,
    box: tuple[float, float, float, float] = (-4.5, 1.5, -3.5, 3.5),
    ax: Any = None,
) -> Any:
    """Where a step does not grow, in the complex plane, and the eigenvalues of a problem times dt on top.

        |R(z)| <= 1,  z = dt lambda;   R(z) what one step of size 1 makes of 1 on y' = z y

    Args:
      steps: {name: step}, methods without separate treatment of position and velocity.
      eigenvalues: complex numbers lambda, 1/s; None draws the regions alone.
      dt: step size, s.
      box: smallest and largest real part, smallest and largest imaginary part.
      ax: matplotlib axes; None makes a figure.
    Returns: the axes.
    Raises: ValueError, if dt is not positive.
    Example:
      >>> import jeuler
      >>> from jeuler.plotting import stability_regions
      >>> ax = stability_regions({"Euler": jeuler.euler_step}, eigenvalues=[-1 + 2j, -1 - 2j], dt=0.5)
      >>> ax.lines[-1].get_xdata().tolist(), [text.get_text() for text in ax.texts]
      ([-0.5, -0.5], ['Euler'])

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.2.
    """
    checks.positive("dt", dt, "s")
    ax = axes_or_new(ax, size=(6.5, 6))
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
        stable = z[(gain <= 1) & (z.imag >= 0)]
        if stable.size:
            top = stable[np.argmax(stable.imag)]
            labels.append((top.real, top.imag, name, f"C{index}"))
    if eigenvalues is not None:
        points = dt * np.asarray(eigenvalues)
        ax.plot(points.real, points.imag, "k.", markersize=5)
        ax.set_title(f"dots: eigenvalues times dt = {dt:g}", fontsize=9)
    ax.set(xlabel="Re dt λ", ylabel="Im dt λ", aspect="equal", xlim=box[:2], ylim=box[2:])
    label_ends(ax, labels)
    return ax
