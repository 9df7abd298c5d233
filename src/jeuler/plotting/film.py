"""Films of particles: GIF, MP4, or a player for a notebook."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib import animation, colors
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from jeuler._core.component import result
from jeuler.particles.state import check_run
from jeuler.plotting.camera import Camera, View, new_axes
from jeuler.plotting.render import Look, Picture, alive_of


def animate(
    solution: Any, scene: Any = None, path: Any = None, *, fps: int = 25, every: int = 1,
    size: tuple[float, float] = (6.0, 4.5), dpi: int = 80,
    camera: Camera | None = None, look: Look | None = None, title: str | None = None,
    progress: bool = True,
) -> Film:  # fmt: skip
    """A film of a solution: to GIF, MP4 or HTML by the end of the path, or an HTML player in a notebook.

    Args:
      solution: what `simulate` returned, its ``.y`` a `ParticleState` with leading axis saved.
      scene: the `Scene`, for its springs and colliders.
      path: ".gif" is written by Pillow, ".mp4" by ffmpeg (of the PATH, or ``pip install
        'jeuler[plot]'``), ".html" holds a player; None writes nothing yet.
      fps: frames a second of the film.
      every: takes each every-th saved state.
      size, dpi: of the picture, inches and dots an inch.
      camera: what is shown; None fits all particles of the whole film.
      look: how it is shown, the background for one.
      title: put above each frame; "{t}" in it becomes the time.
      progress: shows a progress bar while frames are drawn.
    Returns: a `Film`, shown as a player by a notebook; ``.save(path)`` writes it.
    Raises: ValueError, if the solution holds no states, or the path ends otherwise; RuntimeError, for ".mp4" without
      ffmpeg, saying what to do.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting import animate
      >>> state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.ones((1, 2)))
      >>> film = animate(jeuler.simulate(jeuler.Scene(), state, dt=0.1, num_steps=3))
      >>> film.frames
      4
    """
    check_run("animate", solution)
    film = Film(solution, scene, fps, every, size, dpi, camera or Camera(), look or Look(), title, progress)
    if path is not None:
        film.save(path)
    return film


@result
class Film:
    """Frames of a solution that are drawn when they are asked for."""

    solution: Any
    scene: Any
    fps: int
    every: int
    size: tuple[float, float]
    dpi: int
    camera: Camera
    look: Look
    title: str | None
    progress: bool

    @property
    def frames(self) -> int:
        return len(range(0, len(self.solution.t), self.every))

    def __repr__(self) -> str:
        last = float(np.asarray(self.solution.t)[-1])
        return f"Film({self.frames} frames, to t = {last:g} s, {self.fps} a second of film)"

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
            if ffmpeg() is None:
                raise RuntimeError(
                    f"writing {path.name} needs the program ffmpeg, which is not on the PATH; install it or "
                    f"'jeuler[plot]', or write {path.with_suffix('.gif').name} or {path.with_suffix('.html').name}"
                )
            return Mp4Writer(fps=self.fps)
        raise ValueError(f"the film's path must end in .gif, .mp4 or .html, got {path.name!r}")

    def write(self, path: Any, writer: Any) -> None:
        figure, pictures = self._draw_all()
        with writer.saving(figure, str(path), dpi=self.dpi):
            for _ in pictures:
                writer.grab_frame(facecolor=self.look.background)
        plt.close(figure)

    def _repr_html_(self) -> str:
        """The player that a notebook shows."""
        import tempfile

        with tempfile.TemporaryDirectory() as folder, matplotlib.rc_context({"animation.embed_limit": 1e4}):
            path = pathlib.Path(folder) / "film.html"
            self.write(path, animation.HTMLWriter(fps=self.fps, embed_frames=True, default_mode="loop"))
            return path.read_text(encoding="utf-8")

    def _draw_all(self) -> tuple[Figure, Iterator[None]]:
        """A figure, and an iterator that draws one frame after the other on it."""
        state = jax.tree.map(lambda x: np.asarray(x)[:: self.every], self.solution.y)
        times = np.asarray(self.solution.t)[:: self.every]
        ax = new_axes(state.position.shape[-1], self.look.background, self.size)
        view = View.of(self.camera, state.position, alive_of(state)).filling(ax)
        dark = np.mean(colors.to_rgb(self.look.background)) < 0.5

        def frames() -> Iterator[None]:
            from tqdm import tqdm

            picture = None
            for n in tqdm(range(len(times)), desc="drawing", unit="frame", disable=not self.progress):
                frame = jax.tree.map(lambda x, n=n: x[n], state)
                picture = picture or Picture(ax, self.scene, view, self.look, frame, float(times[n]))
                picture.update(frame, float(times[n]))
                if self.title:
                    ax.figure.suptitle(
                        self.title.format(t=f"{times[n]:.2f}"), y=0.97, color="white" if dark else "black"
                    )
                yield

        return ax.figure, frames()


def ffmpeg() -> str | None:
    """The program ffmpeg: that of the PATH, or the one that the package imageio-ffmpeg brings; None without either."""
    if animation.FFMpegWriter.isAvailable():
        return str(matplotlib.rcParams["animation.ffmpeg_path"])
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    return str(imageio_ffmpeg.get_ffmpeg_exe())


class Mp4Writer(animation.FFMpegWriter):
    """Matplotlib's writer of MP4, by the program that `ffmpeg` finds."""

    @classmethod
    def bin_path(cls) -> str:
        return ffmpeg() or super().bin_path()


class GifWriter(animation.PillowWriter):
    """Pillow's writer with an octree palette for each frame: ten times faster than its median cut."""

    def grab_frame(self, **options: Any) -> None:
        from PIL import Image

        super().grab_frame(**options)
        self._frames: list[Any]
        frame = self._frames[-1].convert("RGB")
        self._frames[-1] = frame.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
