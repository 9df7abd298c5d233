"""What sensors measure of particles: where they are, how they move, what pulls at them."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, ParticleIndices, default
from jeuler._core.component import component, store_as_float
from jeuler._core.indices import Indices, different_particles
from jeuler._core.vectors import length
from jeuler.forces.springs import Springs
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState


class _OfParticles:
    """What is measured of particles, one by one: chosen ones, or all."""

    particles: Any

    def __post_init__(self) -> None:
        if self.particles is not None:
            name = f"{type(self).__name__}.particles"
            object.__setattr__(self, "particles", different_particles(name, self.particles))

    def _rows(self, x: Array) -> Array:
        return x if self.particles is None else x[self.particles[:]]

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        if self.particles is not None:
            checks.indices(f"{type(self).__name__}.particles", self.particles[:], particles)


@component(static=("particles",))
class Position(_OfParticles):
    """Where particles are.

    Args:
      particles: which of them, integers (k,); None takes all. Static.
    Returns: called as ``(t, scene, state)``, (k, dim), m.
    Raises: ValueError, if particles are no integers or repeated; in a fit, if one is out of range.
    Example:
      >>> import jeuler
      >>> state = jeuler.ParticleState([[0.0], [2.0]], [[1.0], [3.0]])
      >>> jeuler.observing.Position([1])(0.0, jeuler.Scene(), state).tolist()
      [[2.0]]
    """

    particles: ParticleIndices = default(None)

    quantity: ClassVar[str] = "position"
    unit: ClassVar[str] = "m"

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        return self._rows(state.position)


@component(static=("particles",))
class Velocity(_OfParticles):
    """How fast particles are.

    Args:
      particles: which of them, integers (k,); None takes all. Static.
    Returns: called as ``(t, scene, state)``, (k, dim), m/s.
    Raises: ValueError, if particles are no integers or repeated; in a fit, if one is out of range.
    Example:
      >>> import jeuler
      >>> state = jeuler.ParticleState([[0.0], [2.0]], [[1.0], [3.0]])
      >>> jeuler.observing.Velocity()(0.0, jeuler.Scene(), state).tolist()
      [[1.0], [3.0]]
    """

    particles: ParticleIndices = default(None)

    quantity: ClassVar[str] = "velocity"
    unit: ClassVar[str] = "m/s"

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        return self._rows(state.velocity)


@component(static=("particles",))
class Acceleration(_OfParticles):
    """What accelerometers on particles read: a phone's, with gravity in it, or with gravity taken off.

        a_i = F_i / m_i - gravity

    Of the forces and prescribed motion of the scene; impacts are no part of it. A pinned particle has a = 0.

    Args:
      particles: which of them, integers (k,); None takes all. Static.
      gravity: (dim,), m/s^2, the field that accelerometers fall with, such as ``[0.0, -9.81]``: at rest one reads 9.81
        upwards. None for the acceleration itself, which phones call linear acceleration.
    Returns: called as ``(t, scene, state)``, (k, dim), m/s^2.
    Raises: ValueError, if particles are no integers or repeated, or gravity is not made of finite numbers; in a fit, if
      an index is out of range or gravity has another dim.
    Example:
      >>> import jeuler
      >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=8.0, kd=0.0, rest_length=1.0),))
      >>> state = jeuler.ParticleState([[0.0], [1.5]], [[0.0], [0.0]], mass=2.0)
      >>> jeuler.observing.Acceleration([1])(0.0, scene, state).round(4).tolist()
      [[-2.0]]
    """

    particles: ParticleIndices = default(None)
    gravity: OptionalParameter = default(None)

    quantity: ClassVar[str] = "acceleration"
    unit: ClassVar[str] = "m/s^2"

    def __post_init__(self) -> None:
        super().__post_init__()
        store_as_float(self, "gravity")
        if self.gravity is not None:
            checks.finite("Acceleration.gravity", self.gravity)

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        y, args = (state.position, state.velocity), scene.attributes(state)
        a = self._rows(scene.without_effects().vector_field(t, y, args)[1])
        return a if self.gravity is None else a - self.gravity.astype(a.dtype)

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        super().check(scene, particles, dim)
        if self.gravity is not None:
            checks.shape("Acceleration.gravity", self.gravity.shape, (dim,), meaning="(dim,)")


@component(static=("pairs",))
class Distance:
    """How far two particles are from each other, as a string pot or an ultrasonic ranger measures.

    Args:
      pairs: the two particles, integers (2,), or of several distances (k, 2). Static.
    Returns: called as ``(t, scene, state)``, () or (k,), m.
    Raises: ValueError, if pairs are no integers of that shape; in a fit, if one is out of range.
    Example:
      >>> import jeuler
      >>> state = jeuler.ParticleState([[0.0, 0.0], [3.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]])
      >>> jeuler.observing.Distance([0, 1])(0.0, jeuler.Scene(), state).item()
      5.0
    """

    pairs: ParticleIndices

    quantity: ClassVar[str] = "distance"
    unit: ClassVar[str] = "m"

    def __post_init__(self) -> None:
        _store_pairs(self)

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        return length(_between(self, state))

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        checks.indices("Distance.pairs", self.pairs[...].ravel(), particles)


@component(static=("pairs",))
class Angle:
    """The direction of one particle seen from another, in the plane, as an encoder in the pivot measures.

        angle = atan2(z x d, z.d),   d = p_j - p_i

    Positive counterclockwise from the direction z. A fit compares angles up to full turns, so that a record may be
    unwrapped or not.

    Args:
      pairs: the particles (i, j), pivot first, integers (2,), or of several angles (k, 2). Static.
      zero: z, (2,), the direction that counts as 0: downwards, unless told otherwise.
    Returns: called as ``(t, scene, state)``, () or (k,), rad, from -pi to pi.
    Raises: ValueError, if pairs are no integers of that shape, or zero points nowhere; in a fit, if an index is out of
      range or the scene is not plane.
    Example:
      >>> import jeuler
      >>> state = jeuler.ParticleState([[0.0, 0.0], [1.0, -1.0]], [[0.0, 0.0], [0.0, 0.0]])
      >>> round(jeuler.observing.Angle([0, 1])(0.0, jeuler.Scene(), state).item(), 4)
      0.7854
    """

    pairs: ParticleIndices
    zero: Parameter = default((0.0, -1.0))

    quantity: ClassVar[str] = "angle"
    unit: ClassVar[str] = "rad"
    period: ClassVar[float] = 2 * np.pi

    def __post_init__(self) -> None:
        _store_pairs(self)
        store_as_float(self, "zero")
        checks.shape("Angle.zero", self.zero.shape, (2,))
        checks.points_somewhere("Angle.zero", self.zero)

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        d = _between(self, state)
        x, y = self.zero.astype(d.dtype)
        return jnp.arctan2(x * d[..., 1] - y * d[..., 0], x * d[..., 0] + y * d[..., 1])

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        checks.indices("Angle.pairs", self.pairs[...].ravel(), particles)
        if dim != 2:
            raise ValueError(
                f"Angle needs positions in the plane, got {dim} dimensions; observe a function of the state"
            )


def _store_pairs(observation: Any) -> None:
    name = f"{type(observation).__name__}.pairs"
    given = checks.integers(name, observation.pairs, "integers (2,) or (k, 2), particle indices")
    if given.shape[-1:] != (2,) or given.ndim > 2:
        raise ValueError(f"{name} must have shape (2,) or (k, 2), got {given.shape}")
    object.__setattr__(observation, "pairs", Indices(given, name))


def _between(observation: Any, state: ParticleState) -> Array:
    """From the first of each pair to the second."""
    pairs = observation.pairs[...]
    return state.position[pairs[..., 1]] - state.position[pairs[..., 0]]


@component(static=("springs",))
class SpringForce:
    """The pull in springs, as a load cell at one end of them measures: positive where a spring is longer than at rest.

        T = ks (r - L) + kd dr/dt

    Args:
      springs: which of the scene's springs, integers (k,), counted through all its `Springs`; None takes all. Static.
    Returns: called as ``(t, scene, state)``, (k,), N.
    Raises: ValueError, if springs are no integers or repeated; in a fit, if the scene has no such spring.
    Example:
      >>> import jeuler
      >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=8.0, kd=0.5, rest_length=1.0),))
      >>> state = jeuler.ParticleState([[0.0], [1.5]], [[0.0], [2.0]])
      >>> jeuler.observing.SpringForce()(0.0, scene, state).tolist()
      [5.0]
    """

    springs: ParticleIndices = default(None)

    quantity: ClassVar[str] = "force"
    unit: ClassVar[str] = "N"

    def __post_init__(self) -> None:
        if self.springs is not None:
            object.__setattr__(self, "springs", different_particles("SpringForce.springs", self.springs))

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        pulls = [force.tension(t, state) for force in scene.forces if isinstance(force, Springs)]
        all_of_them = jnp.concatenate(pulls)
        return all_of_them if self.springs is None else all_of_them[self.springs[:]]

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        count = sum(len(force.edges) for force in scene.forces if isinstance(force, Springs))
        if not count:
            raise ValueError("SpringForce needs a scene with springs, got none")
        if self.springs is not None:
            checks.indices("SpringForce.springs", self.springs[:], count)


@component(static=("particles",))
class Projection(_OfParticles):
    """Where particles appear in a camera's picture.

        (u w, v w, w) = M (x, y, z, 1)

    Args:
      matrix: M, (3, dim + 1), the camera's own matrix times its place, from a calibration.
      particles: which of them, integers (k,); None takes all. Static.
    Returns: called as ``(t, scene, state)``, (k, 2), in the units of the picture, such as pixels.
    Raises: ValueError, if the matrix is not made of finite numbers, or particles are no integers or repeated; in a fit,
      if an index is out of range or the matrix has another shape.
    Example:
      >>> import jeuler
      >>> camera = jeuler.observing.Projection([[100.0, 0.0, 50.0, 0.0], [0.0, 100.0, 50.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
      >>> state = jeuler.ParticleState([[0.5, -0.5, 2.0]], [[0.0, 0.0, 0.0]])
      >>> camera(0.0, jeuler.Scene(), state).tolist()
      [[75.0, 25.0]]

    Source: R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2004, eq. 6.2.
    """

    matrix: Parameter
    particles: ParticleIndices = default(None)

    quantity: ClassVar[str] = "place in the picture"
    unit: ClassVar[str] = "pixel"

    def __post_init__(self) -> None:
        store_as_float(self, "matrix")
        checks.finite("Projection.matrix", self.matrix)
        super().__post_init__()

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        p = self._rows(state.position)
        matrix = self.matrix.astype(p.dtype)
        picture = p @ matrix[:, :-1].T + matrix[:, -1]
        return picture[:, :2] / picture[:, 2:]

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        super().check(scene, particles, dim)
        checks.shape("Projection.matrix", self.matrix.shape, (3, dim + 1), meaning="(3, dim + 1)")
