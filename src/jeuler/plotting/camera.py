"""From where a picture of particles is taken, and what it shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib import pyplot as plt

from jeuler._core.component import result


@result
class Camera:
    """What a picture shows.

    Args:
      center: (dim,), m, the middle of the view; None takes the middle of the particles over the whole film.
      width: m, the width of the view; None fits the particles.
      follow: a particle's index or "mean": the view moves along with it.
      elevation, azimuth: in space, the direction from which one looks, degrees; azimuth may be a function of time.
    Example:
      >>> from jeuler.plotting import Camera
      >>> Camera(width=3.0, azimuth=lambda t: 10 * t).azimuth(2.0)  # turns by 10 degrees a second
      20.0
    """

    center: Any = None
    width: float | None = None
    follow: int | str | None = None
    elevation: float = 12.0
    azimuth: float | Callable[[float], float] = -60.0


def new_axes(dim: int, background: Any, size: tuple[float, float] = (6.0, 4.5)) -> Any:
    """Axes without a frame, that keep what is round round."""
    figure = plt.figure(figsize=size, facecolor=background)
    ax: Any
    if dim == 3:  # axes in space are square: let the square cover the whole picture
        square = max(size) / np.array(size)
        ax = figure.add_axes((*(1 - square) / 2, *square), projection="3d")
    else:
        ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_facecolor(background)
    ax.set_axis_off()
    if dim < 3:
        ax.set_aspect("equal", adjustable="box")
    else:
        ax.set_proj_type("ortho")
        ax.computed_zorder = False  # solids first; what they hide is left out (`in_sight`)
    return ax


def in_plane(x: Any) -> np.ndarray:
    """Points (..., dim); those of a line, dim = 1, as points of the plane with height 0."""
    x = np.asarray(x)
    return np.concatenate([x, np.zeros_like(x)], axis=-1) if x.shape[-1] == 1 else x


@dataclasses.dataclass(frozen=True)
class View:
    """The camera with all its numbers: the middle of the picture and half its extent."""

    camera: Camera
    center: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, camera: Camera, position: np.ndarray, alive: np.ndarray) -> View:
        """Fits positions (frame, particle, dim), those of the living."""
        position = in_plane(position)
        dim = position.shape[-1]
        seen = position[alive] if alive.any() else np.zeros((1, dim))
        low, high = np.percentile(seen, [0.5, 99.5], axis=0) if len(seen) > 2000 else (seen.min(0), seen.max(0))
        center = (low + high) / 2 if camera.center is None else in_plane(np.asarray(camera.center, float))
        half = 0.55 * (high - low)
        half = np.maximum(half, 0.2 * half.max() or 1.0)
        if camera.width is not None:
            half = np.full(dim, camera.width / 2) * (1.0 if dim == 3 else np.array([1.0, 0.7]))
        return cls(camera, center, half)

    def filling(self, ax: Any) -> View:
        """In the plane, the view with its height or width grown to the shape of the axes, so that no strip is left."""
        if len(self.half) == 3:
            return self
        box = ax.get_window_extent()
        x, y = self.half
        return dataclasses.replace(
            self, half=np.array([max(x, y * box.width / box.height), max(y, x * box.height / box.width)])
        )

    def aim(self, ax: Any, position: np.ndarray, alive: np.ndarray, t: float) -> None:
        """Point the axes at the scene."""
        center, camera = self.center, self.camera
        if camera.follow is not None and alive.any():
            center = position[alive].mean(axis=0) if camera.follow == "mean" else position[int(camera.follow)]
        limits = np.stack([center - self.half, center + self.half])
        ax.set_xlim(*limits[:, 0])
        ax.set_ylim(*limits[:, 1])
        if len(center) == 3:
            ax.set_zlim(*limits[:, 2])
            azimuth = camera.azimuth(t) if callable(camera.azimuth) else camera.azimuth
            ax.view_init(elev=camera.elevation, azim=azimuth)
            ax.set_box_aspect(tuple(self.half))
            width, height = 72 * ax.figure.get_size_inches()
            wanted = width / (2 * self.half[:2].max())
            if camera.width is None:
                wanted = min(
                    wanted, height / (2 * self.half[2] + self.half[:2].max() * np.sin(np.radians(camera.elevation)))
                )
            ax.set_box_aspect(tuple(self.half), zoom=float(wanted / self.points_a_metre(ax)))
        ax.autoscale(False)

    def toward_viewer(self, t: float) -> np.ndarray:
        """The unit vector from the scene to the camera."""
        azimuth = self.camera.azimuth(t) if callable(self.camera.azimuth) else self.camera.azimuth
        a, e = np.radians(azimuth), np.radians(self.camera.elevation)
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    def points_a_metre(self, ax: Any) -> float:
        """How long a metre across the view is in the picture, in points."""
        if len(self.half) == 2:
            ends = np.stack([self.center, self.center + np.array([1, 0])])
        else:
            from mpl_toolkits.mplot3d import proj3d

            x, y, _ = self.toward_viewer(0.0)
            across = np.array([-y, x, 0.0]) / np.hypot(x, y)
            ends = np.stack([self.center, self.center + across])
            ends = np.stack(proj3d.proj_transform(*ends.T, ax.get_proj())[:2], axis=1)
        a, b = ax.transData.transform(ends)
        return float(np.hypot(*(b - a))) * 72 / ax.figure.dpi
