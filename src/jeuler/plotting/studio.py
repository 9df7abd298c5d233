"""Pictures with perspective, light and shadow: drawn by VTK through PyVista, without a window."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from matplotlib import colors
from PIL import Image

from jeuler._core.arguments import says_what_to_write
from jeuler.particles.state import ParticleState
from jeuler.plotting.camera import Camera, View
from jeuler.plotting.light import light_through
from jeuler.plotting.models import Model, Shadows, bake, copies, frame_along, model, unit
from jeuler.plotting.render import (
    Look,
    alive_of,
    colliders_of,
    color_of_strain,
    colors_of,
    ends_of,
    springs_of,
    trails_of,
)
from jeuler.plotting.surfaces import ball, fine_mesh_of

FINER = 2  # pixels drawn for one of the picture, each way
ANGLE = 26.0  # of view, degrees
SUN = (-0.55, 0.35, 0.75)  # to the right of the eye, toward the eye, up
SHUTTER = 0.03  # s, of "streaks"


@says_what_to_write()
def still(
    frame: ParticleState, scene: Any = None, path: Any = None, *, size: tuple[int, int] = (1600, 1000),
    camera: Camera | None = None, look: Look | None = None, t: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """A picture of one moment in space, with perspective, smooth surfaces, and the shadows of sun and sky.

    It is drawn by VTK without a window (``pip install 'jeuler[render]'``, which brings PyVista; without a graphics card
    Mesa's software renderer does it, Debian's libegl1 and libgl1-mesa-dri). Faces are subdivided and their normals
    smoothed; particles are balls, or what ``look.particles`` says.

    Args:
      frame: a `ParticleState`, position (particle, 3).
      scene: the `Scene`, for its springs and colliders; None draws the particles alone.
      path: where to write it, a name that ends in .png, .jpg or another that Pillow knows; None only returns it.
      size: width and height, pixels.
      camera: what is shown; None fits the particles.
      look: how it is shown.
      t: the time, s, for colliders that move.
    Returns: the picture, (height, width, 3), integers from 0 to 255.
    Raises: ValueError, if the frame has a time axis or is not in space; RuntimeError without PyVista, saying what
      to do.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> from jeuler.plotting import still
      >>> state = jeuler.ParticleState(jnp.zeros((1, 3)), jnp.zeros((1, 3)), size=jnp.ones(1))
      >>> still(state, size=(160, 100)).shape  # doctest: +SKIP
      (100, 160, 3)
    """
    position = np.asarray(frame.position)
    if position.ndim != 2 or position.shape[1] != 3:
        raise ValueError(
            f"still needs positions of shape (particle, 3), got {position.shape}; of a solution take one frame, "
            f"jax.tree.map(lambda x: x[n], solution.y), and draw what lies in a plane by plotting.draw"
        )
    studio = Studio(_library(), jax.tree.map(np.asarray, frame), scene, camera or Camera(), look or Look(), t)
    picture = studio.photograph(size)
    if path is not None:
        Image.fromarray(picture).save(path)
    return picture


def _library() -> Any:
    try:
        import pyvista
    except ImportError:
        raise RuntimeError(
            "still needs the library pyvista, which is not installed; pip install 'jeuler[render]', or plotting.draw"
        ) from None
    return pyvista


class Studio:
    """One moment with its camera and lights."""

    def __init__(self, pv: Any, frame: ParticleState, scene: Any, camera: Camera, look: Look, t: float) -> None:
        self.pv, self.scene, self.look, self.t = pv, scene, look, t
        alive = alive_of(frame)
        self.index = np.flatnonzero(alive)
        self.trails = trails_of(frame, alive, colors_of(frame)) if hasattr(frame, "trail") else None
        self.position, self.velocity = np.asarray(frame.position, float), np.asarray(frame.velocity, float)
        self.rgba, self.size = colors_of(frame), None if frame.size is None else np.asarray(frame.size)
        self.view = View.of(camera, self.position[None], alive[None])
        self.toward = self.view.toward_viewer(t)
        level = unit(self.toward * [1, 1, 0])
        right = np.array([-level[1], level[0], 0.0])
        self.sun = unit(SUN[0] * right + SUN[1] * level + SUN[2] * np.array([0.0, 0.0, 1.0]))
        self.open: list[Any] = []
        self.reach = float(self.view.half[:2].max())

    def photograph(self, size: tuple[int, int]) -> np.ndarray:
        self.eye = self.view.center + self.reach * size[1] / size[0] / np.tan(np.radians(ANGLE / 2)) * self.toward
        models = [*self._solids(), *self._surface(), *self._bodies()]
        curves = self._curves()
        baked = bake(models, self._shadows(models, curves), self.sun, self.eye, self.reach)
        plotter = self.pv.Plotter(off_screen=True, window_size=tuple(FINER * n for n in size), lighting="none")
        plotter.set_background(self.look.background, top=self.look.sky or self.look.background)
        for m, rgba in zip(models, baked, strict=True):
            self._add(plotter, m, self._faded(m, rgba))
        for line, rgba, width in curves:
            self._add_curves(plotter, line, rgba, width)
        if self.look.particles == "puffs":
            self._puffs(plotter, self.index, self.position[self.index], self.rgba[self.index])
        if self.look.dust:
            self._dust(plotter)
        camera = plotter.camera
        camera.position, camera.focal_point, camera.up = self.eye, self.view.center, (0.0, 0.0, 1.0)
        camera.view_angle, camera.clipping_range = ANGLE, (0.05 * self.reach, 100 * self.reach)
        picture = Image.fromarray(np.asarray(plotter.screenshot(return_img=True))[..., :3])
        for each in (plotter, *self.open):
            each.close()
        return np.asarray(picture.resize(size, Image.Resampling.BOX))

    def _faded(self, m: Model, rgba: np.ndarray) -> np.ndarray:
        """What is far fades into the sky, bytes."""
        far = np.linalg.norm(m.points - self.eye, axis=1) / np.linalg.norm(self.view.center - self.eye)
        haze = (1 - np.exp(-self.look.haze * np.maximum(far - 1.2, 0)))[:, None]
        rgb = rgba[:, :3] * (1 - haze) + haze * np.array(colors.to_rgb(self.look.background))
        return np.round(255 * np.concatenate([rgb, rgba[:, 3:]], axis=1)).astype(np.uint8)

    def _add(self, plotter: Any, m: Model, rgba: np.ndarray) -> None:
        clear = (m.rgba[:, 3] < 1).any()  # what is seen through is drawn from the back to the front
        order = np.argsort(m.points[m.faces].mean(axis=1) @ self.toward) if clear else slice(None)
        mesh = self.pv.PolyData.from_regular_faces(m.points, m.faces[order])
        mesh.point_data["rgba"] = rgba if clear else rgba[:, :3]
        plotter.add_mesh(mesh, scalars="rgba", rgb=True, lighting=False)

    def _add_curves(self, plotter: Any, curves: np.ndarray, rgba: np.ndarray, width: float) -> None:
        mesh = self._line_mesh(curves)
        mesh.point_data["rgba"] = np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8).reshape(-1, rgba.shape[-1])
        plotter.add_mesh(mesh, scalars="rgba", rgb=True, line_width=FINER * width, lighting=False)

    def _line_mesh(self, curves: np.ndarray) -> Any:
        many, points = curves.shape[:2]
        cells = np.column_stack([np.full(many, points), np.arange(many * points).reshape(many, points)])
        return self.pv.PolyData(curves.reshape(-1, 3), lines=cells.ravel())

    def _shadows(self, models: list[Model], curves: list[Any], pixels: int = 1000) -> Callable[[np.ndarray], Shadows]:
        """Makes the map of what is first in the light from a direction: drawn by a camera there."""
        casting = [m for m in models if m.casts]
        lines = [line for line, _, width in curves if width > 0.5]
        points = np.concatenate([*(m.points for m in casting), *(x.reshape(-1, 3) for x in lines), np.zeros((0, 3))])
        plotter = self.pv.Plotter(off_screen=True, window_size=(pixels, pixels), lighting="none")
        self.open.append(plotter)
        for m in casting:
            plotter.add_mesh(self.pv.PolyData.from_regular_faces(m.points, m.faces), lighting=False)
        for line in lines:
            plotter.add_mesh(self._line_mesh(line), lighting=False, line_width=2)

        plotter.show(auto_close=False)

        def seen_from(way: np.ndarray) -> Shadows:
            frame = frame_along(way)
            if not len(points):
                return Shadows(frame, np.zeros(2), 1.0, np.full((1, 1), -np.inf))
            low, high = (points @ frame.T).min(axis=0), (points @ frame.T).max(axis=0)
            middle, wide = (low + high) / 2, 1.04 * (high - low)[:2].max()
            deep = high[2] - low[2] + 1e-3 * wide
            camera = plotter.camera
            camera.focal_point, camera.up = middle @ frame, frame[1]
            camera.position = middle @ frame + deep * way
            camera.parallel_projection, camera.parallel_scale = True, wide / 2
            camera.clipping_range = (0.4 * deep, 1.6 * deep)
            plotter.render()
            depth = z_buffer(plotter.render_window)
            height = np.where(depth < 1, middle[2] + deep - (0.4 + 1.2 * depth) * deep, -np.inf)
            return Shadows(frame, middle[:2] - wide / 2, wide / pixels, height)

        return seen_from

    def _solids(self) -> list[Model]:
        fill, made = np.array(colors.to_rgba(self.look.solids)), []
        for collider in colliders_of(self.scene):
            points, faces, is_ground = fine_mesh_of(collider, self.t, self.view.center, self.view.half)
            if len(faces):
                made.append(model(points, faces, fill, casts=not is_ground))
        return made

    def _surface(self) -> list[Model]:
        if self.look.faces is None:
            return []
        faces = np.asarray(self.look.faces)
        mesh = self.pv.PolyData.from_regular_faces(self.position, faces)
        mesh.point_data["rgba"] = self.rgba
        mesh = mesh.clean().compute_normals(cell_normals=False, split_vertices=False)  # one way round
        mesh = mesh.subdivide(2 if len(faces) < 20000 else 1, "loop")
        rgba = np.clip(np.asarray(mesh.point_data["rgba"]), 0, 1)
        clear = rgba[:, 3].min() < 1
        kind = {"shine": 0.7, "soft": 0.45} if clear else {"shine": 0.06, "soft": 0.1}
        return [model(np.asarray(mesh.points), np.asarray(mesh.regular_faces), rgba, **kind)]

    def _bodies(self) -> list[Model]:
        """Particles as balls, or as runners or birds that look along their velocity."""
        shapes = {True: round_body, "runners": runner, "birds": bird}
        if self.look.particles not in shapes or not len(self.index):
            return []
        shape = shapes[self.look.particles]()
        size = np.full(len(self.index), 0.02 * self.reach) if self.size is None else self.size[self.index]
        level = [1, 1, 0] if self.look.particles == "runners" else [1, 1, 1]
        way = None if self.look.particles is True else self.velocity[self.index] * level + [1e-9, 0, 0]
        return [copies(shape, self.position[self.index], size, self.rgba[self.index], way)]

    def _curves(self) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Hair, springs, trails and streaks: curves (curve, point, 3), colours (curve, point, 4), width."""
        made = []
        if self.look.hair is not None:
            curves, rgba = self.look.hair.lit(self.position, self.rgba, self.sun, self.toward)
            made.append((curves, rgba, self.look.width))
        for force in springs_of(self.scene) if self.look.links and self.look.hair is None else []:
            edges = np.asarray(force.edges)
            strain = color_of_strain(force, self.position, self.t)
            color = self.rgba[edges].mean(axis=1) if self.look.links == "color" else strain
            here = np.isin(edges, self.index).all(axis=1)
            made.append((ends_of(force, self.position)[here], color[here][:, None].repeat(2, 1), self.look.width))
        if self.trails is not None:
            made.append((*self.trails, self.look.width))
        if self.look.particles == "streaks":
            back = SHUTTER * np.linspace(1, 0, 6)[:, None]
            curves = self.position[self.index][:, None] - back * self.velocity[self.index][:, None]
            rgba = self.rgba[self.index][:, None].repeat(6, 1)
            rgba[..., 3] *= np.linspace(0.02, 1, 6)
            made.append((curves, rgba, self.look.width))
        return made

    def _puffs(self, plotter: Any, who: np.ndarray, at: np.ndarray, rgba: np.ndarray, size: Any = None) -> None:
        """Soft balls, the far ones first, each lit by what comes through the others."""
        order = np.argsort(at @ self.toward)
        if size is None:
            size = np.full(len(order), 0.02 * self.reach) if self.size is None else self.size[who]
        at, rgba, size = at[order], rgba[order].copy(), size[order]
        area = np.pi / 4 * size**2 * rgba[:, 3]
        lit = light_through(at, self.look.thickness * area, self.sun, 0.04 * self.reach)
        rgba[:, :3] *= (0.22 + 0.9 * lit)[:, None]
        cloud = self.pv.PolyData(at)
        cloud.point_data["rgba"] = np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)
        cloud.point_data["size"] = size
        actor = plotter.add_mesh(
            cloud, scalars="rgba", rgb=True, style="points_gaussian", emissive=False, lighting=False, opacity=0.999
        )
        actor.mapper.SetScaleArray("size")
        actor.mapper.SetScaleFactor(0.3)

    def _dust(self, plotter: Any) -> None:
        """Behind each runner, the more the faster: puffs along its way of the last second."""
        random, per_runner = np.random.default_rng(0), 3
        who = np.repeat(self.index, per_runner)
        ago = random.uniform(0.05, 1.0, (len(who), 1))
        size = np.ones(len(who)) if self.size is None else self.size[who]
        at = self.position[who] - ago * self.velocity[who] + random.normal(0, 0.15, (len(who), 3)) * size[:, None]
        at[:, 2] += size * (0.35 * ago[:, 0] - 0.45)
        speed = np.linalg.norm(self.velocity[who], axis=1)
        rgba = np.tile([*colors.to_rgb(self.look.dust), 0.0], (len(who), 1))
        rgba[:, 3] = 0.16 * (1 - ago[:, 0]) * np.clip(speed / (1e-9 + np.percentile(speed, 90)), 0, 1)
        self._puffs(plotter, who, at, rgba, size * (0.5 + 1.5 * ago[:, 0]))


def round_body() -> Model:
    points, faces = ball(np.zeros(3), 0.5, 6)
    return Model(points, 2 * points, np.ones((len(points), 4)), faces, shine=0.3)


def runner() -> Model:
    """A body one high that looks along x and leans into its way: trunk, head, arms and legs in stride."""
    limbs = [  # from, to, radius, brightness
        ((0.02, 0.0, -0.06), (0.14, 0.0, 0.28), 0.12, 1.0),
        ((0.02, 0.06, -0.08), (0.26, 0.07, -0.30), 0.06, 0.45), ((0.26, 0.07, -0.30), (0.18, 0.07, -0.5), 0.05, 0.45),
        ((0.02, -0.06, -0.08), (-0.10, -0.07, -0.30), 0.06, 0.45),
        ((-0.10, -0.07, -0.30), (-0.34, -0.07, -0.34), 0.05, 0.45),
        ((0.13, 0.15, 0.24), (-0.02, 0.19, 0.06), 0.045, 0.9), ((0.13, -0.15, 0.24), (0.30, -0.17, 0.10), 0.045, 0.9),
        ((0.19, 0.0, 0.41), (0.20, 0.0, 0.43), 0.1, 1.6),
    ]  # fmt: skip
    parts = [capsule(np.array(a), np.array(b), radius, tint) for a, b, radius, tint in limbs]
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "normals", "rgba")]
    return dataclasses.replace(parts[0], points=joined[0], normals=joined[1], rgba=joined[2], faces=faces)


def bird() -> Model:
    """Wings one wide, raised, and a body that looks along x."""
    wings = [[0.3, 0, 0], [-0.05, 0.5, 0.16], [-0.12, 0, 0], [-0.05, -0.5, 0.16]]
    points = np.array([*wings, [-0.35, 0.08, 0], [-0.35, -0.08, 0]])
    return model(points, np.array([[0, 1, 2], [0, 2, 3], [2, 4, 5]]), np.ones(4), shine=0.0)


def capsule(a: np.ndarray, b: np.ndarray, radius: float, tint: float) -> Model:
    """A rod with round ends."""
    points, faces = ball(np.zeros(3), 1.0, 3)
    along = unit(b - a)
    across = unit(np.cross(along, [0.0, 1.0, 0.1]))
    normals = points @ np.stack([across, np.cross(along, across), along])
    middle = np.where(points[:, 2:] > 0, b, a)
    rgba = np.tile([tint, tint, tint, 1.0], (len(points), 1))
    return Model(middle + radius * normals, normals, rgba, faces, shine=0.1)


def z_buffer(window: Any) -> np.ndarray:
    """The depth of each pixel of a window of VTK, from 0 to 1: (row, column)."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.SetInputBufferTypeToZBuffer()
    grab.ReadFrontBufferOff()
    grab.Update()
    image = grab.GetOutput()
    width, height, _ = image.GetDimensions()
    return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width)
