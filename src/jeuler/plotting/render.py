"""Pictures and films of particles: each drawn with its colour, opacity, size and marker, springs by their strain."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib import animation, colors
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure

from jeuler.declare import declared
from jeuler.plotting.solids import draw_collider, in_sight
from jeuler.state import ParticleState

MARKERS = ("o", "s", "^", "D", "*")  # by state.shape
DEFAULT_COLOR, DEFAULT_SIZE = (0.13, 0.35, 0.62), 4.0  # points, where the state has no size
STRAIN = colors.LinearSegmentedColormap.from_list("strain", ["#2166ac", "#555555", "#b2182b"])


@dataclasses.dataclass(frozen=True)
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


def draw(
    frame: ParticleState, scene: Any = None, *, ax: Any = None, camera: Camera | None = None, t: float = 0.0,
    background: Any = "white",
) -> Any:  # fmt: skip
    """Draw the particles of one moment, and of the scene its springs and colliders.

    Particles take colour, opacity, size (m) and shape from the state; the dead are not drawn. A spring is grey at its
    rest length, red where stretched and blue where pressed, full at 20 % strain.

    Args:
      frame: a `ParticleState`, position (particle, dim) with dim 2 or 3.
      scene: the `Scene`; None draws the particles alone.
      ax: Matplotlib axes to draw on, of projection "3d" in space; None makes new ones.
      camera: what is shown; None fits the particles.
      t: the time, s, for colliders that move.
      background: colour of the picture.
    Returns: the axes.
    Raises: ValueError, if the frame has a time axis or its dimension is not 2 or 3.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting.render import draw
      >>> state = jeuler.ParticleState(jnp.array([[0.0, 0.0], [1.0, 1.0]]), jnp.zeros((2, 2)))
      >>> len(draw(state, jeuler.Scene((jeuler.Springs([[0, 1]], 1.0, 0.0, 1.0),))).collections)
      2
    """
    position = np.asarray(frame.position)
    if position.ndim != 2 or position.shape[1] not in (2, 3):
        raise ValueError(
            f"frame.position must have shape (particle, 2) or (particle, 3), got {position.shape}; of a solution take "
            f"one frame, jax.tree.map(lambda x: x[n], solution.y)"
        )
    camera = camera or Camera()
    if ax is None:
        ax = new_axes(position.shape[1], background)
    view = View.of(camera, position[None], alive_of(frame)[None])
    Picture(ax, scene, view, frame, t).update(frame, t)
    return ax


def save_picture(path: Any, frame: ParticleState, scene: Any = None, *, size: tuple = (6.0, 4.5), dpi: int = 80,
                 background: Any = "white", **options: Any) -> None:  # fmt: skip
    """Draw one moment to a file; ``options`` are those of `draw`."""
    ax = new_axes(np.shape(frame.position)[-1], background, size)
    draw(frame, scene, ax=ax, background=background, **options)
    ax.figure.savefig(path, dpi=dpi, facecolor=background)
    plt.close(ax.figure)


def animate(
    solution: Any, scene: Any = None, path: Any = None, *, fps: int = 25, every: int = 1, size: tuple = (6.0, 4.5),
    dpi: int = 80, camera: Camera | None = None, background: Any = "white", title: str | None = None,
    progress: bool = True,
) -> Film:  # fmt: skip
    """A film of a solution: to GIF, MP4 or HTML by the end of the path, or an HTML player in a notebook.

    Args:
      solution: what `simulate` returned, its ``.y`` a `ParticleState` with leading axis saved.
      scene: the `Scene`, for its springs and colliders.
      path: ".gif" is written by Pillow, ".mp4" by ffmpeg, ".html" holds a player; None writes nothing yet.
      fps: frames a second of the film.
      every: takes each every-th saved state.
      size, dpi: of the picture, inches and dots an inch.
      camera: what is shown; None fits all particles of the whole film.
      background: colour of the picture.
      title: put above each frame; "{t}" in it becomes the time.
      progress: shows a progress bar while frames are drawn.
    Returns: a `Film`, shown as a player by a notebook; ``.save(path)`` writes it.
    Raises: ValueError, if the solution holds no states, or the path ends otherwise; RuntimeError, for ".mp4" without
      ffmpeg, saying what to do.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting.render import animate
      >>> state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.ones((1, 2)))
      >>> film = animate(jeuler.simulate(jeuler.Scene(), state, dt=0.1, num_steps=3))
      >>> film.frames
      4
    """
    if not isinstance(solution.y, ParticleState) or np.ndim(solution.y.position) != 3:
        raise ValueError(
            "animate needs a solution whose .y is a ParticleState with leading axis saved; run simulate with "
            "save=None, and take one member of a batch"
        )
    film = Film(solution, scene, fps, every, size, dpi, camera or Camera(), background, title, progress)
    if path is not None:
        film.save(path)
    return film


@dataclasses.dataclass(frozen=True)
class Film:
    """Frames of a solution that are drawn when they are asked for."""

    solution: Any
    scene: Any
    fps: int
    every: int
    size: tuple
    dpi: int
    camera: Camera
    background: Any
    title: str | None
    progress: bool

    @property
    def frames(self) -> int:
        return len(range(0, len(self.solution.t), self.every))

    def save(self, path: Any) -> None:
        """Write the film: .gif, .mp4 or .html."""
        path = pathlib.Path(path)
        if path.suffix == ".html":
            path.write_text(self._repr_html_(), encoding="utf-8")
            return
        self.write(path, self.writer(path))

    def writer(self, path: pathlib.Path) -> Any:
        if path.suffix == ".gif":
            return GifWriter(fps=self.fps)
        if path.suffix == ".mp4":
            if not animation.FFMpegWriter.isAvailable():
                raise RuntimeError(
                    f"writing {path.name} needs the program ffmpeg, which is not on the PATH; "
                    f"install it, or write {path.with_suffix('.gif').name} or {path.with_suffix('.html').name}"
                )
            return animation.FFMpegWriter(fps=self.fps)
        raise ValueError(f"the film's path must end in .gif, .mp4 or .html, got {path.name!r}")

    def write(self, path: Any, writer: Any) -> None:
        figure, pictures = self._draw_all()
        with writer.saving(figure, str(path), dpi=self.dpi):
            for _ in pictures:
                writer.grab_frame(facecolor=self.background)
        plt.close(figure)

    def _repr_html_(self) -> str:
        """The player that a notebook shows."""
        import tempfile

        with tempfile.TemporaryDirectory() as folder, matplotlib.rc_context({"animation.embed_limit": 60}):
            path = pathlib.Path(folder) / "film.html"
            self.write(path, animation.HTMLWriter(fps=self.fps, embed_frames=True, default_mode="loop"))
            return path.read_text(encoding="utf-8")

    def _draw_all(self) -> tuple[Figure, Iterator[None]]:
        """A figure, and an iterator that draws one frame after the other on it."""
        state = jax.tree.map(lambda x: np.asarray(x)[:: self.every], self.solution.y)
        times = np.asarray(self.solution.t)[:: self.every]
        ax = new_axes(state.position.shape[-1], self.background, self.size)
        view = View.of(self.camera, state.position, alive_of(state))

        def frames() -> Iterator[None]:
            from tqdm import tqdm

            picture = None
            for n in tqdm(range(len(times)), desc="drawing", unit="frame", disable=not self.progress):
                frame = jax.tree.map(lambda x, n=n: x[n], state)
                picture = picture or Picture(ax, self.scene, view, frame, times[n])
                picture.update(frame, float(times[n]))
                if self.title:
                    ax.figure.suptitle(self.title.format(t=f"{times[n]:.2f}"), y=0.97)
                yield

        return ax.figure, frames()


class GifWriter(animation.PillowWriter):
    """Pillow's writer with an octree palette for each frame: ten times faster than its median cut."""

    def grab_frame(self, **options: Any) -> None:
        from PIL import Image

        super().grab_frame(**options)
        self._frames: list[Any]
        frame = self._frames[-1].convert("RGB")
        self._frames[-1] = frame.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def alive_of(state: ParticleState) -> np.ndarray:
    """Which particles are drawn: (..., particle)."""
    finite = np.isfinite(np.asarray(state.position)).all(axis=-1)
    return finite if state.alive is None else finite & np.asarray(state.alive)


def new_axes(dim: int, background: Any, size: tuple = (6.0, 4.5)) -> Any:
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
    if dim == 2:
        ax.set_aspect("equal", adjustable="box")
    else:
        ax.set_proj_type("ortho")
        ax.computed_zorder = False  # solids first; what they hide is left out (`in_sight`)
    return ax


@dataclasses.dataclass(frozen=True)
class View:
    """The camera with all its numbers: the middle of the picture and half its extent."""

    camera: Camera
    center: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, camera: Camera, position: np.ndarray, alive: np.ndarray) -> View:
        """Fits positions (frame, particle, dim), those of the living."""
        dim = position.shape[-1]
        seen = position[alive] if alive.any() else np.zeros((1, dim))
        low, high = np.percentile(seen, [0.5, 99.5], axis=0) if len(seen) > 2000 else (seen.min(0), seen.max(0))
        center = (low + high) / 2 if camera.center is None else np.asarray(camera.center, float)
        half = 0.55 * (high - low)
        half = np.maximum(half, 0.2 * half.max() or 1.0)
        if camera.width is not None:
            half = np.full(dim, camera.width / 2) * (1.0 if dim == 3 else np.array([1.0, 0.7]))
        return cls(camera, center, half)

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


class Picture:
    """The artists of one scene, made once and moved from frame to frame."""

    def __init__(self, ax: Any, scene: Any, view: View, frame: ParticleState, t: float) -> None:
        self.ax, self.view = ax, view
        self.solids: list[Any] = []
        position = np.asarray(frame.position)
        self.dim = position.shape[1]
        view.aim(ax, position, alive_of(frame), t)
        forces, effects = getattr(scene, "forces", ()), getattr(scene, "effects", ())
        self.colliders = [collider for effect in effects for collider in declared(effect, "colliders")]
        self.springs = [force for force in forces if hasattr(force, "rest_length")]
        self.lines = [self._new_lines() for _ in self.springs]
        self.dots: list[PathCollection] = []
        self.moving = any(callable(value) for c in self.colliders for value in vars(c).values())
        self._draw_solids(t)

    def _new_lines(self) -> Any:
        if self.dim == 2:
            return self.ax.add_collection(LineCollection([], linewidths=0.9, zorder=2))
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        return self.ax.add_collection(Line3DCollection([np.zeros((2, 3))], linewidths=0.9))

    def _draw_solids(self, t: float) -> None:
        for artist in self.solids:
            artist.remove()
        self.solids = [
            a for c in self.colliders for a in draw_collider(self.ax, c, t, self.view.center, self.view.half)
        ]

    def update(self, frame: ParticleState, t: float) -> None:
        """Show another frame."""
        position, alive = np.asarray(frame.position), alive_of(frame)
        self.view.aim(self.ax, position, alive, t)
        if self.moving:
            self._draw_solids(t)
        if self.dim == 3 and self.colliders:
            toward = self.view.toward_viewer(t)
            alive = alive & in_sight(self.colliders, t, position, toward, 2 * self.view.half.max())
        for force, lines in zip(self.springs, self.lines, strict=True):
            edges = np.asarray(force.edges)
            edges = edges[alive[edges].all(axis=1)]
            ends = position[edges]
            rest = np.broadcast_to(np.asarray(force.rest_length), len(np.asarray(force.edges)))
            rest = rest[alive[np.asarray(force.edges)].all(axis=1)]
            strain = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / np.where(rest > 0, rest, 1) - 1
            lines.set_segments(ends)
            lines.set_color(STRAIN(np.clip(0.5 + strain / 0.4, 0, 1)))
        for dots in self.dots:
            dots.remove()
        self.dots = self._draw_particles(frame, position, alive)

    def _draw_particles(self, frame: ParticleState, position: np.ndarray, alive: np.ndarray) -> list[Any]:
        shape = np.zeros(len(position), int) if frame.shape is None else np.asarray(frame.shape) % len(MARKERS)
        rgba = np.empty((len(position), 4))
        rgba[:, :3] = DEFAULT_COLOR if frame.color is None else np.clip(np.asarray(frame.color), 0, 1)
        rgba[:, 3] = 1.0 if frame.opacity is None else np.clip(np.asarray(frame.opacity), 0, 1)
        if frame.size is None:
            points = np.full(len(position), DEFAULT_SIZE if not self.springs else 1.5)
        else:
            points = np.asarray(frame.size) * self.view.points_a_metre(self.ax)
        artists = []
        for marker in np.unique(shape[alive]):
            here = alive & (shape == marker)
            artists.append(
                self.ax.scatter(
                    *position[here].T,
                    s=points[here] ** 2,
                    c=rgba[here],
                    marker=MARKERS[marker],
                    linewidths=0,
                    zorder=3,
                    **({"depthshade": False} if self.dim == 3 else {}),
                )
            )
        return artists
