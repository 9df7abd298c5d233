"""The picture of a fit."""

from __future__ import annotations

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.files import write_atomically
from jeuler.commands.estimate import Estimate
from jeuler.commands.selection import Measurement

MOST_POINTS = 4000


def draw(measured: Measurement, found: Estimate, picture: str, result: dict[str, Any]) -> None:
    """Data, model and residual."""
    import matplotlib.pyplot as plt

    from jeuler.plotting.fits import plain_text, plot_fit

    spring = result["springs"][0]
    source = os.path.basename(measured.source)
    title = f"{source}: ks = {spring['ks']:.4g} N/m, kd = {spring['kd']:.3g} N s/m"
    if len(result["springs"]) > 1:
        title = f"{source}: {len(result['springs'])} springs fitted"
    thin = max(1, len(measured.times) // MOST_POINTS)
    count = len(measured.times[::thin])
    figure = plot_fit(
        measured.times[::thin],
        measured.positions[::thin].reshape(count, -1),
        found.predicted[::thin].reshape(count, -1),
        names=tuple(map(plain_text, measured.names)),
        curve=_curve(measured, found),
        title=plain_text(title),
        unit=measured.unit,
    )
    figure.axes[0].set_ylabel(f"{measured.quantity} [{measured.unit}]")
    kind = os.path.splitext(os.path.realpath(picture))[1][1:].lower() or "png"
    write_atomically(picture, lambda path: figure.savefig(path, dpi=130, format=kind))
    plt.close(figure)


def _curve(measured: Measurement, found: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """The model at its own steps."""
    model = found.model
    t0, steps = model.grid(measured.times, found.dt)
    thin = max(1, steps // (2 * MOST_POINTS))

    @jax.jit
    def values(params: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        p, v, mass, scene = model.motion(params, found.dt, steps, t0)
        t = t0 + found.dt * jnp.arange(steps + 1)[::thin]
        return t, model.observed(params, scene, mass, t, p[::thin], v[::thin])

    t, y = values(found.params)
    return np.asarray(t), np.asarray(y).reshape(len(t), -1)
