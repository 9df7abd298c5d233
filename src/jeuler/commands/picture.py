"""The picture of a fit."""

from __future__ import annotations

import os
from typing import Any

from jeuler._core.files import write_atomically
from jeuler.commands.estimate import MOST_POINTS, Estimate
from jeuler.commands.selection import Measurement


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
        curve=(found.curve[0], found.curve[1].reshape(len(found.curve[0]), -1)),
        title=plain_text(title),
        unit=measured.unit,
    )
    figure.axes[0].set_ylabel(f"{measured.quantity} [{measured.unit}]")
    kind = os.path.splitext(os.path.realpath(picture))[1][1:].lower() or "png"
    write_atomically(picture, lambda path: figure.savefig(path, dpi=130, format=kind))
    plt.close(figure)
