"""How much light comes through a cloud of particles."""

from __future__ import annotations

import numpy as np

from jeuler.plotting.models import frame_along


def light_through(points: np.ndarray, weight: np.ndarray, toward: np.ndarray, cell: float) -> np.ndarray:
    """The share of the light that reaches each point (point, 3) past all others, (point,).

        share_i = exp(-sum_j weight_j / cell^2),  j nearer to the light and in the same column of cells

    weight: the area that each covers, (point,), m^2; toward: the unit vector to the light; cell: the width of a
    column, m. Sums are taken between cells, so that there are no seams.

    Source: T. Lokovic, E. Veach, Deep Shadow Maps, SIGGRAPH 2000; columns of cells stand for their pixels.
    """
    place = points @ frame_along(-toward).T / cell
    place = place - place.min(axis=0) + 1
    shape = tuple(np.ceil(place.max(axis=0)).astype(int) + 3)
    low, share = np.floor(place).astype(int), place - np.floor(place)
    corners = [
        (low + corner, np.prod(np.where(corner, share, 1 - share), axis=1))
        for corner in np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    ]
    density = np.zeros(shape)
    for at, part in corners:
        np.add.at(density, tuple(at.T), part * weight)
    before = np.cumsum(density, axis=2) - density
    depth = sum(part * before[tuple(at.T)] for at, part in corners)
    return np.exp(-depth / cell**2)
