"""Samplers of points and directions: where newborns appear, and which way they go."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, SampledParameter, default
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler._core.vectors import direction
from jeuler.samplers.base import Sampler, as_sampler, numbers_of, standard_normal


@component()
class FromLine(Sampler):
    """Uniform on a line segment.

        x = start + (end - start) u

    Args:
      start: (dim,), m. Differentiable.
      end: (dim,), m. Differentiable.
    Returns: called as ``sampler(key, count)``, (count, dim), m.
    Raises: ValueError, if start or end is not one point, (dim,).
    Example:
      >>> import jax, jeuler
      >>> x = jeuler.FromLine([0.0, 1.0], [2.0, 1.0])(jax.random.key(0), 3)
      >>> x.shape, x[:, 1].tolist()
      ((3, 2), [1.0, 1.0, 1.0])
    """

    start: Parameter
    end: Parameter

    axes: ClassVar[dict[str, int]] = {"start": 1, "end": 1}

    def __post_init__(self) -> None:
        store_as_float(self, "start", "end")
        check_points("FromLine", start=self.start, end=self.end)

    numbers = 1

    def at(self, u: Array) -> Array:
        return self.start + (self.end - self.start) * u.T


@component()
class FromDisc(Sampler):
    """Uniform on a disc: in the plane, or in space across a normal.

        x = center + radius sqrt(u) (cos a, sin a)

    Args:
      center: (dim,), m, dim 2 or 3. Differentiable.
      radius: (), m, >= 0. Differentiable.
      normal: (3,), the axis of a disc in space; ignored in the plane.
    Returns: called as ``sampler(key, count)``, (count, dim), m.
    Raises: ValueError, if the center is not one point, the radius is negative or the normal is 0.
    Example:
      >>> import jax, jeuler
      >>> x = jeuler.FromDisc([0.0, 0.0, 5.0], 1.0)(jax.random.key(0), 4)
      >>> x.shape, x[:, 2].tolist()
      ((4, 3), [5.0, 5.0, 5.0, 5.0])

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983,
      sect. 2 (attributes drawn at birth).
    """

    center: Parameter
    radius: Parameter
    normal: Parameter = default((0.0, 0.0, 1.0))

    limits: ClassVar[dict[str, Any]] = {"center": ("", "m"), "radius": (">= 0", "m"), "normal": ("", "")}
    axes: ClassVar[dict[str, int]] = {"center": 1, "radius": 0, "normal": 1}

    def __post_init__(self) -> None:
        store_as_float(self, "center", "radius", "normal")
        check_points("FromDisc", center=self.center)
        checks.shape("FromDisc.center", self.center.shape[-1:], (2,), (3,))
        checks.points_somewhere("FromDisc.normal", self.normal)
        check_limits(self)

    numbers = 2

    def at(self, u: Array) -> Array:
        r, angle = self.radius * jnp.sqrt(u[0]), 2 * jnp.pi * u[1]
        x, y = (r * jnp.cos(angle))[:, None], (r * jnp.sin(angle))[:, None]
        if len(self.center) == 2:
            return self.center + jnp.concatenate([x, y], axis=1)
        first, second, _ = frame(self.normal)
        return self.center + x * first + y * second


@component(static=("surface",))
class FromSphere(Sampler):
    """Uniform in a ball, or on its surface, in any dimension.

        x = center + radius u^(1/dim) n / |n|,   n standard normal

    Args:
      center: (dim,), m. Differentiable.
      radius: (), m, >= 0. Differentiable.
      surface: True draws from the surface only.
    Returns: called as ``sampler(key, count)``, (count, dim), m.
    Raises: ValueError, if the center is not one point or the radius is negative.
    Example:
      >>> import jax, jax.numpy as jnp, jeuler
      >>> x = jeuler.FromSphere([0.0, 0.0, 0.0], 2.0, surface=True)(jax.random.key(0), 4)
      >>> bool(jnp.allclose(jnp.linalg.norm(x, axis=1), 2.0))
      True

    Source: M. E. Muller, A note on a method for generating points uniformly on n-dimensional spheres, 1959.
    """

    center: Parameter
    radius: Parameter
    surface: bool = False

    limits: ClassVar[dict[str, Any]] = {"center": ("", "m"), "radius": (">= 0", "m")}
    axes: ClassVar[dict[str, int]] = {"center": 1, "radius": 0}

    def __post_init__(self) -> None:
        store_as_float(self, "center", "radius")
        check_points("FromSphere", center=self.center)
        checks.true_or_false("FromSphere.surface", self.surface)
        check_limits(self)

    @property
    def numbers(self) -> int:
        return len(self.center) + (not self.surface)

    def at(self, u: Array) -> Array:
        dim = len(self.center)
        _, n = direction(standard_normal(u[:dim]).T)
        share = 1.0 if self.surface else u[dim:].T ** (1 / dim)
        return self.center + self.radius * share * n


@component(static=("faces",))
class FromSurface(Sampler):
    """Uniform on a surface of triangles (in space or in the plane).

        x = a + s (b - a) + q (c - a),   a triangle (a, b, c) drawn by its area

    Args:
      vertices: (vertex, dim), m. Differentiable; which triangle is drawn is not.
      faces: the three vertices of each triangle, integers (face, 3). Static.
    Returns: called as ``sampler(key, count)``, (count, dim), m.
    Raises: ValueError, if faces is not (face, 3) or names a vertex that is not there.
    Example:
      >>> import jax, jeuler
      >>> jeuler.FromSurface([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]])(jax.random.key(0), 7).shape
      (7, 2)

    Source: R. Osada et al., Shape distributions, ACM Transactions on Graphics 21, 2002, sect. 4.2.
    """

    vertices: Parameter
    faces: tuple[tuple[int, int, int], ...]

    def __post_init__(self) -> None:
        store_as_float(self, "vertices")
        if self.vertices.ndim < 2:
            raise ValueError(f"FromSurface.vertices must have shape (vertex, dim), got {self.vertices.shape}")
        faces = checks.integers("FromSurface.faces", self.faces, "integers of shape (face, 3)")
        if faces.shape[1:] != (3,) or not faces.size:
            raise ValueError(f"FromSurface.faces must be integers of shape (face, 3), got {faces.shape}")
        checks.indices("FromSurface.faces", faces, len(self.vertices))
        object.__setattr__(self, "faces", tuple(map(tuple, faces.tolist())))

    numbers = 3

    def at(self, u: Array) -> Array:
        a, b, c = (self.vertices[np.array(self.faces)[:, k]] for k in range(3))
        ab, ac = b - a, c - a
        square = jnp.sum(ab**2, -1) * jnp.sum(ac**2, -1) - jnp.sum(ab * ac, -1) ** 2  # 4 area^2
        up_to = jnp.cumsum(jnp.sqrt(jax.lax.stop_gradient(square)))
        face = jnp.searchsorted(up_to[:-1], u[0] * up_to[-1], side="right")
        place = u[1:, :, None]
        s, q = jnp.where(place.sum(axis=0) > 1, 1 - place, place)  # the far half of the parallelogram folds back
        return a[face] + s * ab[face] + q * ac[face]


@component()
class Cone(Sampler):
    """Velocities in a cone: directions uniform in the solid angle about an axis, speeds from a sampler.

        v = speed (cos b axis + sin b side)
        in space cos b is uniform in [cos angle, 1], in the plane b in [-angle, angle]

    Args:
      direction: the axis, (dim,), any length, dim 2 or 3. Differentiable.
      speed: (), m/s, or a sampler of it. Differentiable.
      angle: half the opening angle, (), rad, >= 0; pi is every direction. Differentiable.
    Returns: called as ``sampler(key, count)``, (count, dim), m/s.
    Raises: ValueError, if the direction is 0 or not (dim,), or the angle is negative.
    Example:
      >>> import jax, jeuler
      >>> jet = jeuler.Cone([0.0, 0.0, 1.0], speed=jeuler.Uniform(4.0, 6.0), angle=0.2)
      >>> v = jet(jax.random.key(0), 50)
      >>> v.shape, bool((v[:, 2] > 3.9).all())
      ((50, 3), True)

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983, sect. 2.2.
    """

    direction: Parameter
    speed: SampledParameter
    angle: Parameter = default(0.0)

    limits: ClassVar[dict[str, Any]] = {"direction": ("", ""), "speed": (">= 0", "m/s"), "angle": (">= 0", "rad")}
    axes: ClassVar[dict[str, int]] = {"direction": 1, "speed": 0, "angle": 0}

    def __post_init__(self) -> None:
        store_as_float(self, "direction", "angle")
        object.__setattr__(self, "speed", as_sampler("Cone.speed", self.speed))
        if self.speed is None:
            raise ValueError("Cone.speed must be a speed in m/s or a sampler of it, got None")
        check_points("Cone", direction=self.direction)
        checks.shape("Cone.direction", self.direction.shape[-1:], (2,), (3,))
        checks.points_somewhere("Cone.direction", self.direction)
        check_limits(self)

    @property
    def numbers(self) -> int | None:
        for_speed = numbers_of(self.speed)
        return None if for_speed is None else 2 + for_speed

    def __call__(self, key: Array, count: int) -> Array:
        if self.numbers is not None:
            return super().__call__(key, count)
        for_speed, for_angle = jax.random.split(key)
        u = jax.random.uniform(for_angle, (2, count), self.direction.dtype)
        return self.along(u, self.speed(for_speed, count))

    def at(self, u: Array) -> Array:
        return self.along(u[:2], self.speed.at(u[2:]) if callable(self.speed) else self.speed)

    def along(self, u: Array, speed: Array) -> Array:
        """Velocities of these speeds, in directions drawn by two uniform numbers each."""
        u, speed = u[..., None], speed.reshape(-1, 1)
        if len(self.direction) == 2:
            _, axis = direction(self.direction)
            side = jnp.stack([-axis[1], axis[0]])
            turn = self.angle * (2 * u[0] - 1)
            return speed * (jnp.cos(turn) * axis + jnp.sin(turn) * side)
        first, second, axis = frame(self.direction)
        # with w = 2 sin(angle / 2)^2 = 1 - cos(angle): 1 - cos b = u w, smooth also at angle = 0
        down = u[0] * 2 * jnp.sin(self.angle / 2) ** 2
        sine = jnp.sqrt(u[0]) * 2 * jnp.sin(self.angle / 2) * jnp.sqrt(1 - down / 2)
        around = 2 * jnp.pi * u[1]
        return speed * ((1 - down) * axis + sine * (jnp.cos(around) * first + jnp.sin(around) * second))


def check_points(name: str, **points: Array) -> None:
    """Each of these is a finite point or vector, (dim,), or a batch of them for ``vmap``, and all have the same dim."""
    first = next(iter(points.values())).shape[-1:]
    for field, x in points.items():
        if not x.ndim or x.shape[-1:] != first:
            raise ValueError(f"{name}.{field} must have shape {first or '(dim,)'}, got {x.shape}")
        checks.finite(f"{name}.{field}", x)


def frame(axis: Array) -> tuple[Array, Array, Array]:
    """Two unit vectors across a direction in space, and the direction itself: a right-handed frame."""
    _, third = direction(axis)
    seed = jnp.where(jnp.abs(third[2]) < 0.9, jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0]))
    _, first = direction(jnp.cross(seed.astype(third.dtype), third))
    return first, jnp.cross(third, first), third
