"""A run of particles that is turned with the mouse, in a notebook or as one HTML file."""

from __future__ import annotations

import dataclasses
import html
import pathlib
from typing import Any

import jax
import numpy as np
from matplotlib import colors

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.particles.state import ParticleState, check_run, in_space
from jeuler.plotting.camera import Camera, View
from jeuler.plotting.render import Look, alive_of, colliders_of, color_of_strain, colors_of, ends_of, springs_of
from jeuler.plotting.solids import FILL
from jeuler.plotting.surfaces import mesh_of

MOST_FRAMES = 100
FIELD_OF_VIEW = 30.0  # degrees


@says_what_to_write()
def view(
    solution: Any, scene: Any = None, path: Any = None, *, every: int | None = None,
    camera: Camera | None = None, look: Look | None = None,
) -> TurnableView:  # fmt: skip
    """A run that can be turned, moved and brought nearer with the mouse, and played in time.

    It is drawn by WebGL in the browser, by the library k3d (``pip install 'jeuler[view]'``), whose script is part of
    the page: a page of 1.2 MB and the positions, that reads nothing from a network.

    Args:
      solution: what `simulate` returned, its ``.y`` a `ParticleState` with leading axis saved; what lies on a line or
        in a plane is put into space at height 0.
      scene: the `Scene`, for its springs and colliders.
      path: ".html", written at once; None writes nothing yet.
      every: takes each every-th saved state; None as many as make no more than 100 frames.
      camera: from where one looks at first.
      look: springs, faces, particles and background, as in `draw`.
    Returns: a `TurnableView`, shown by a notebook; ``.save("run.html")`` writes it.
    Raises: ValueError, if the solution holds no states, or the path does not end in .html; RuntimeError without k3d,
      saying what to do.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting import view
      >>> state = jeuler.ParticleState(jnp.zeros((1, 3)), jnp.ones((1, 3)))
      >>> view(jeuler.simulate(jeuler.Scene(), state, dt=0.1, num_steps=3))
      TurnableView(4 frames, 1 particles, to t = 0.3 s)
    """
    check_run("view", solution)
    if every is None:
        every = -(-len(solution.t) // MOST_FRAMES)
    every = checks.count("every", every, least=1)
    shown = TurnableView(solution, scene, every, camera or Camera(), look or Look())
    if path is not None:
        shown.save(path)
    return shown


@result
class TurnableView:
    """A run as a page that is made when it is asked for."""

    solution: Any
    scene: Any
    every: int
    camera: Camera
    look: Look

    def __repr__(self) -> str:
        frames, last = len(range(0, len(self.solution.t), self.every)), float(np.asarray(self.solution.t)[-1])
        return f"TurnableView({frames} frames, {self.solution.y.position.shape[1]} particles, to t = {last:g} s)"

    def save(self, path: Any) -> None:
        """Write the page: one .html, without a network."""
        path = pathlib.Path(path)
        if path.suffix != ".html":
            raise ValueError(f"the view's path must end in .html, got {path.name!r}")
        path.write_text(self.page(), encoding="utf-8")

    def _repr_html_(self) -> str:
        """What a notebook shows: the page in a frame of its own."""
        page = html.escape(self.page(), quote=True)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 480px; border: 0"></iframe>'

    def page(self) -> str:
        """The page."""
        k3d = _library()
        state = jax.tree.map(lambda x: np.asarray(x)[:: self.every], self.solution.y)
        flat = state.position.shape[-1] < 3
        state = state.replace(position=in_space(state.position))
        times = np.asarray(self.solution.t, float)[:: self.every]
        camera = self.camera
        if camera.center is not None:
            camera = dataclasses.replace(camera, center=in_space(np.asarray(camera.center, float)))
        extent = View.of(camera, state.position, alive_of(state))
        plot = k3d.plot(
            name="jeuler", grid_visible=False, camera_auto_fit=False, camera_fov=FIELD_OF_VIEW, axes_helper=0,
            background_color=int(packed(colors.to_rgb(self.look.background))), additional_js_code=PLAY,
        )  # fmt: skip
        plot.camera = first_look(extent, times[0], flat)
        for drawn in (*self._bodies(k3d, state, times, extent), *self._solids(k3d, times, extent)):
            plot += drawn
        return str(plot.get_snapshot())

    def _bodies(self, k3d: Any, state: ParticleState, times: np.ndarray, extent: View) -> list[Any]:
        """Particles, springs and faces at all times."""
        frames = [jax.tree.map(lambda x, n=n: x[n], state) for n in range(len(times))]
        alive: Any = alive_of(state)
        position: Any = np.where(alive[..., None], np.asarray(state.position), extent.center).astype(np.float32)
        rgba, drawn = np.stack([colors_of(frame) for frame in frames]), []

        def in_time(values: Any) -> dict[str, Any]:
            return {str(float(t)): value for t, value in zip(times, values, strict=True)}

        if self.look.particles:
            default = 0.012 * extent.half.max()
            size = np.full(alive.shape, default) if state.size is None else np.asarray(state.size)
            size, opacity = (np.where(alive, x, 0).astype(np.float32) for x in (size, rgba[..., 3]))
            drawn.append(k3d.points(
                in_time(position), point_sizes=in_time(size), opacities=in_time(opacity), shader="3d",
                colors=in_time(packed(rgba)), compression_level=9,
            ))  # fmt: skip
        for force in springs_of(self.scene) if self.look.links else []:
            edges = np.asarray(force.edges)
            ends, whole = ends_of(force, position), alive[:, edges].all(axis=2)
            ends = np.where(whole[..., None, None], ends, ends[:, :, :1]).reshape(len(times), -1, 3)
            color = [rgba[n][edges] if self.look.links == "color"
                     else color_of_strain(force, position[n], times[n])[:, None].repeat(2, 1)
                     for n in range(len(times))]  # fmt: skip
            drawn.append(k3d.lines(
                in_time(ends), np.arange(2 * len(edges), dtype=np.uint32).reshape(-1, 2), indices_type="segment",
                colors=in_time([packed(c).ravel() for c in color]), shader="simple", compression_level=9,
            ))  # fmt: skip
        if self.look.faces is not None:
            drawn.append(k3d.mesh(
                in_time(position), np.asarray(self.look.faces, np.uint32), colors=in_time(packed(rgba)),
                opacity=float(rgba[..., 3].mean()), side="double", flat_shading=False, compression_level=9,
            ))  # fmt: skip
        return drawn

    def _solids(self, k3d: Any, times: np.ndarray, extent: View) -> list[Any]:
        """Colliders; those with a place that is a function of time at all times."""
        drawn = []
        for collider in colliders_of(self.scene):
            if self.solution.y.position.shape[-1] < 3:
                continue
            moves = (
                any(callable(value) for value in vars(collider).values()) if hasattr(collider, "__dict__") else False
            )
            meshes = [mesh_of(collider, float(t), extent.center, extent.half) for t in (times if moves else times[:1])]
            points, faces = meshes[0]
            if len(points):
                same = all(len(other) == len(points) for other, _ in meshes) and moves
                at = {str(float(t)): p.astype(np.float32) for t, (p, _) in zip(times, meshes, strict=False)}
                vertices = at if same else points.astype(np.float32)
                drawn.append(k3d.mesh(
                    vertices, faces.astype(np.uint32), color=int(packed(colors.to_rgb(FILL))), side="double",
                    flat_shading=False, compression_level=9,
                ))  # fmt: skip
        return drawn


PLAY = "if (Object.keys(K3DInstance.getWorld().ObjectsListJson).length) { K3DInstance.startAutoPlay(); }"


def _library() -> Any:
    try:
        import k3d
    except ImportError:
        raise RuntimeError("view needs the library k3d, which is not installed; pip install 'jeuler[view]'") from None
    return k3d


def packed(rgb: Any) -> np.ndarray:
    """Colours (..., 3 or 4) from 0 to 1 as integers 0xRRGGBB, (...)."""
    bytes_ = np.round(255 * np.clip(np.asarray(rgb)[..., :3], 0, 1)).astype(np.uint32)
    return np.asarray(bytes_ @ np.array([65536, 256, 1], np.uint32), np.uint32)


def first_look(extent: View, t: float, flat: bool) -> list[float]:
    """Where the eye is, what it looks at, and what is above: (9,). A plane is seen from above."""
    toward, up = (np.array([0.0, 0.0, 1.0]), (0.0, 1.0, 0.0)) if flat else (extent.toward_viewer(t), (0.0, 0.0, 1.0))
    distance = 1.1 * extent.half.max() / np.tan(np.radians(FIELD_OF_VIEW / 2))
    return [float(x) for x in (*(extent.center + distance * toward), *extent.center, *up)]
