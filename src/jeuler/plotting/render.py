"""Pictures of particles: each drawn with its colour, opacity, size and marker, springs as lines, surfaces as faces."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib import colors
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection, PolyCollection

from jeuler._core.component import result
from jeuler.particles.fields import declared
from jeuler.particles.state import ParticleState
from jeuler.plotting.camera import Camera, View, in_plane, new_axes
from jeuler.plotting.solids import draw_colliders, in_sight, shaded

MARKERS = ("o", "s", "^", "D", "*")  # by state.shape
DEFAULT_COLOR, DEFAULT_SIZE = (0.13, 0.35, 0.62), 4.0  # points, where the state has no size
STRAIN = colors.LinearSegmentedColormap.from_list("strain", ["#2166ac", "#555555", "#b2182b"])


@result
class Look:
    """How a picture shows what there is.

    Args:
      background: colour of the picture.
      links: springs as lines, coloured by "strain" (grey at rest length, red where stretched and blue where pressed,
        full at 20 % strain) or by the "color" of their particles, as hair is; None draws none.
      width: of these lines, points.
      faces: the particles at the corners of a surface's triangles, integers (face, 3): cloth, the skin of a body,
        shaded in the colour of its particles.
      particles: True draws them as dots, in `still` as balls; "puffs" are soft and lit through each other, "streaks"
        show the way of the last 0.03 s, "runners" and "birds" are bodies one size high or wide that look along their
        velocity (four looks that only `still` has, elsewhere they are dots); False draws no particles, only what
        they hold.
      sky: colour of the upper end of the background in `still`; None takes the background's.
      solids: colour of solids in `still`. A collider that has ``drawn = False`` is not in any picture.
      hair: a `Hair`, strands about guides, in `still`.
      dust: colour of the dust that runners raise in `still`; None raises none.
      haze: how fast what is far fades into the background in `still`, 0 for clear air.
      thickness: how much light puffs take from those behind them, 0 for none.
    Raises: ValueError, if links or particles is none of these, or faces are not (face, 3).
    Example:
      >>> from jeuler.plotting import Look
      >>> Look(background="black", links="color").width  # hair on black
      0.9
    """

    background: Any = "white"
    links: str | None = "strain"
    width: float = 0.9
    faces: Any = None
    particles: bool | str = True
    sky: Any = None
    solids: Any = "#d9d4c7"
    hair: Any = None
    dust: Any = None
    haze: float = 0.25
    thickness: float = 1.0

    def __post_init__(self) -> None:
        if self.particles not in (True, False, "puffs", "streaks", "runners", "birds"):
            raise ValueError(
                f'Look.particles must be True, False, "puffs", "streaks", "runners" or "birds", got {self.particles!r}'
            )
        if self.links not in ("strain", "color", None):
            raise ValueError(f'Look.links must be "strain", "color" or None, got {self.links!r}')
        shape = np.shape(self.faces)
        if self.faces is not None and (len(shape) != 2 or shape[1] != 3):
            raise ValueError(f"Look.faces must have shape (face, 3), particle indices, got {shape}")


def draw(
    frame: ParticleState, scene: Any = None, *, ax: Any = None, camera: Camera | None = None, look: Look | None = None,
    t: float = 0.0,
) -> Any:  # fmt: skip
    """Draw the particles of one moment, and of the scene its springs and colliders.

    Particles take colour, opacity, size (m) and shape from the state; the dead are not drawn. Where a `Trail` is in the
    state, the way of each is a line of its colour that fades.

    Args:
      frame: a `ParticleState`, position (particle, dim) with dim 1, 2 or 3; what moves on a line is drawn along it.
      scene: the `Scene`; None draws the particles alone.
      ax: Matplotlib axes to draw on, of projection "3d" in space; None makes new ones.
      camera: what is shown; None fits the particles.
      look: how it is shown; None draws springs by their strain on white.
      t: the time, s, for colliders that move.
    Returns: the axes.
    Raises: ValueError, if the frame has a time axis or its dimension is none of 1, 2 and 3.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting import draw
      >>> state = jeuler.ParticleState(jnp.array([[0.0, 0.0], [1.0, 1.0]]), jnp.zeros((2, 2)))
      >>> len(draw(state, jeuler.Scene((jeuler.Springs([[0, 1]], 1.0, 0.0, 1.0),))).collections)
      2
    """
    position = np.asarray(frame.position)
    if position.ndim != 2 or position.shape[1] not in (1, 2, 3):
        raise ValueError(
            f"frame.position must have shape (particle, dim), dim 1, 2 or 3, got {position.shape}; of a solution take "
            f"one frame, jax.tree.map(lambda x: x[n], solution.y)"
        )
    camera, look = camera or Camera(), look or Look()
    if ax is None:
        ax = new_axes(position.shape[1], look.background)
    view = View.of(camera, position[None], alive_of(frame)[None]).filling(ax)
    Picture(ax, scene, view, look, frame, t).update(frame, t)
    return ax


def save_picture(path: Any, frame: ParticleState, scene: Any = None, *, size: tuple[float, float] = (6.0, 4.5),
                 dpi: int = 80, look: Look | None = None, **options: Any) -> None:  # fmt: skip
    """Draw one moment to a file; ``options`` are those of `draw`."""
    look = look or Look()
    ax = new_axes(np.shape(frame.position)[-1], look.background, size)
    draw(frame, scene, ax=ax, look=look, **options)
    ax.figure.savefig(path, dpi=dpi, facecolor=look.background)
    plt.close(ax.figure)


def alive_of(state: ParticleState) -> np.ndarray:
    """Which particles are drawn: (..., particle)."""
    finite = np.isfinite(np.asarray(state.position)).all(axis=-1)
    return finite if state.alive is None else finite & np.asarray(state.alive)


def colors_of(state: ParticleState) -> np.ndarray:
    """Colour and opacity of each particle, (particle, 4)."""
    rgba = np.empty((state.position.shape[0], 4))
    rgba[:, :3] = DEFAULT_COLOR if state.color is None else np.clip(np.asarray(state.color), 0, 1)
    rgba[:, 3] = 1.0 if state.opacity is None else np.clip(np.asarray(state.opacity), 0, 1)
    return rgba


def colliders_of(scene: Any) -> list[Any]:
    """The solids of a scene's effects and forces."""
    colliders = [collider for effect in getattr(scene, "effects", ()) for collider in declared(effect, "colliders")]
    colliders += [force.collider for force in getattr(scene, "forces", ()) if hasattr(force, "collider")]
    return [collider for collider in colliders if declared(collider, "drawn", True)]


def springs_of(scene: Any) -> list[Any]:
    """The springs of a scene and their kin."""
    return [force for force in getattr(scene, "forces", ()) if hasattr(force, "rest_length")]


def ends_of(force: Any, position: np.ndarray) -> np.ndarray:
    """Both ends of each spring, (..., spring, 2, dim), the second at its image nearest to the first."""
    ends = position[..., np.asarray(force.edges), :]
    if getattr(force, "box", None) is not None:
        box = np.asarray(force.box)
        d = (ends[..., 0, :] - ends[..., 1, :])[..., : len(box)]  # what lies in a plane is drawn with a 0 more
        ends[..., 1, : len(box)] += box * np.round(d / box)
    return ends


def color_of_strain(force: Any, position: np.ndarray, t: float) -> np.ndarray:
    """The colour of each spring by its strain, (spring, 4)."""
    ends = ends_of(force, position)
    now = force.at(t) if hasattr(force, "at") else force
    rest = np.broadcast_to(np.asarray(now.rest_length), len(ends))
    strain = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / np.where(rest > 0, rest, 1) - 1
    return STRAIN(np.clip(0.5 + strain / 0.4, 0, 1))


def trails_of(frame: ParticleState, alive: np.ndarray, rgba: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The way of each particle that is drawn, (particle, point, dim), from where it is back, and its fading colours."""
    position = np.asarray(frame.position)[alive]
    ways = np.concatenate([position[:, None], position[:, None] + np.asarray(frame.trail)[alive]], axis=1)
    points = ways.shape[1]
    fading = rgba[alive][:, None].repeat(points, axis=1)
    fading[..., 3] *= np.linspace(1, 0, points) ** 1.5
    return ways, fading


@dataclasses.dataclass(frozen=True)
class AlongLine:
    """A collider of the line, drawn in the plane: all heights are alike."""

    collider: Any

    def __call__(self, t: Any, point: Any) -> Any:
        return self.collider(t, point[:1])


class Picture:
    """The artists of one scene, made once and moved from frame to frame."""

    ax: Any
    view: View
    look: Look
    dim: int
    colliders: list[Any]
    springs: list[Any]
    lines: list[Any]
    faces: Any
    moving: bool
    dot_size: float

    def __init__(self, ax: Any, scene: Any, view: View, look: Look, frame: ParticleState, t: float) -> None:
        self.ax, self.view, self.look = ax, view, look
        position = in_plane(frame.position)
        self.dim = position.shape[1]
        view.aim(ax, position, alive_of(frame), t)
        self.colliders = colliders_of(scene)
        self.springs = springs_of(scene) if look.links else []
        self.dot_size = DEFAULT_SIZE if not self.springs else 1.5
        if np.shape(frame.position)[1] == 1:
            self.colliders = [AlongLine(collider) for collider in self.colliders]
            self.dot_size = 2 * DEFAULT_SIZE
        self.lines = [self._new_lines() for _ in self.springs]
        self.faces = None if look.faces is None else self._new_faces()
        self.trails = self._new_lines() if hasattr(frame, "trail") else None
        self.dots: list[PathCollection] = []
        self.solids: list[Any] = []
        turning = self.dim == 3 and callable(view.camera.azimuth)
        self.moving = turning or any(callable(value) for c in self.colliders for value in vars(c).values())
        self._draw_solids(t)

    def _new_lines(self) -> Any:
        if self.dim == 2:
            return self.ax.add_collection(LineCollection([], linewidths=self.look.width, zorder=2))
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        lines = Line3DCollection([np.zeros((2, 3))], linewidths=self.look.width, zorder=2, capstyle="round")
        return self.ax.add_collection(lines)

    def _new_faces(self) -> Any:
        if self.dim == 2:
            return self.ax.add_collection(PolyCollection([], zorder=1.5))
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        return self.ax.add_collection3d(Poly3DCollection([np.zeros((3, 3))], zorder=1.5, linewidths=0.3))

    def _draw_solids(self, t: float) -> None:
        for artist in self.solids:
            artist.remove()
        self.solids = draw_colliders(self.ax, self.colliders, t, self.view)

    def update(self, frame: ParticleState, t: float) -> None:
        """Show another frame."""
        position, alive, rgba = in_plane(frame.position), alive_of(frame), colors_of(frame)
        self.view.aim(self.ax, position, alive, t)
        if self.moving:
            self._draw_solids(t)
        if self.dim == 3 and self.colliders:
            toward = self.view.toward_viewer(t)
            alive = alive & in_sight(self.colliders, t, position, toward, 2 * self.view.half.max())
        for force, lines in zip(self.springs, self.lines, strict=True):
            self._update_lines(force, lines, position, alive, rgba, t)
        if self.faces is not None:
            corners = np.asarray(self.look.faces)
            corners = corners[alive[corners].any(axis=1) & np.isfinite(position[corners]).all(axis=(1, 2))]
            color = rgba[corners].mean(axis=1)
            if self.dim == 3:
                color = shaded(color, position[corners], self.view.toward_viewer(t))
            self.faces.set_verts(position[corners])
            self.faces.set_facecolor(color)
            self.faces.set_edgecolor(color)
        if self.trails is not None:
            ways, fading = trails_of(frame, alive, rgba)
            pieces = in_plane(np.stack([ways[:, :-1], ways[:, 1:]], axis=2))
            self.trails.set_segments(pieces.reshape(-1, *pieces.shape[2:]))
            self.trails.set_color(fading[:, 1:].reshape(-1, 4))
        for dots in self.dots:
            dots.remove()
        self.dots = self._draw_particles(frame, position, alive, rgba) if self.look.particles else []

    def _update_lines(
        self, force: Any, lines: Any, position: np.ndarray, alive: np.ndarray, rgba: np.ndarray, t: float
    ) -> None:
        edges = np.asarray(force.edges)
        seen = np.flatnonzero(alive[edges].all(axis=1))
        if self.dim == 3:  # the far ones first
            seen = seen[np.argsort(position[edges[seen]].mean(axis=1) @ self.view.toward_viewer(t))]
        ends = ends_of(force, position)[seen]
        lines.set_segments(ends)
        if self.look.links == "color":
            lines.set_color(rgba[edges[seen]].mean(axis=1))
            return
        lines.set_color(color_of_strain(force, position, t)[seen])

    def _draw_particles(
        self, frame: ParticleState, position: np.ndarray, alive: np.ndarray, rgba: np.ndarray
    ) -> list[Any]:
        shape = np.zeros(len(position), int) if frame.shape is None else np.asarray(frame.shape) % len(MARKERS)
        if frame.size is None:
            points = np.full(len(position), self.dot_size)
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
