"""How the air moves: ``air(t, position) -> (particle, dim)`` in m/s. Drag takes particles along with it."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, Parameter, default
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import as_component, component, store_as_float
from jeuler._core.in_time import at_time, moving
from jeuler._core.limits import check_limits


def as_air(air: Any) -> Any:
    """Air given as one field, several that add up, a velocity (dim,), or None for air at rest."""
    if air is None:
        return ()
    if isinstance(air, (tuple, list)) and all(callable(part) for part in air):
        for part in air:
            checks.function("air", part, "(t, position) -> (particle, dim)", "it gets all positions at once")
        return tuple(as_component(part) for part in air)
    checks.refuse_class("air must be a field such as Wind(...)", air)
    if callable(air):
        checks.function("air", air, "(t, position) -> (particle, dim)", "it gets all positions at once")
    return (as_component(air) if callable(air) else Wind(air),)


def air_velocity(air: tuple[Any, ...], t: Any, position: Array) -> Array | float:
    """The sum of the fields at each particle; 0 where there is none."""
    return sum((part(t, position) for part in air), start=0.0)


def check_air(name: str, air: tuple[Any, ...], particles: int, dim: int) -> None:
    """Each field of the air gives a velocity of the right dimension."""
    t, position = jnp.zeros(()), jnp.zeros((particles, dim))
    for part in air:
        try:
            shape = getattr(checks.form_of(f"{name}.air", part, t, position), "shape", "no array")
        except jax.errors.JAXTypeError:
            raise
        except (TypeError, ValueError) as error:
            shape = str(error).splitlines()[0]
        if shape != (particles, dim):
            raise ValueError(
                f"{name}.air must give a velocity of shape ({particles}, {dim}), (particle, dim); "
                f"{type(part).__name__} gives {shape}"
            )


@component()
class Wind:
    """A uniform wind, steady or any function of time.

        w(p, t) = velocity(t)

    Args:
      velocity: (dim,), m/s, or a function ``velocity(t) -> (dim,)``. Differentiable.
    Returns: called as ``air(t, position)``, the velocity of the air at each particle, (particle, dim), m/s.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.Wind([3.0, 0.0])(0.0, jnp.zeros((2, 2))).tolist()
      [[3.0, 0.0], [3.0, 0.0]]
    """

    velocity: MovingParameter

    axes: ClassVar[dict[str, int]] = {"velocity": 1}

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", moving("Wind.velocity", self.velocity))

    def __call__(self, t: Any, position: Array) -> Array:
        return jnp.broadcast_to(at_time(self.velocity, t, position.dtype), position.shape)


@component(positive=("period",))
class Gust:
    """A gust that comes again and again and fades between.

        w(p, t) = velocity (1 - cos(2 pi t / period)) / 2

    Args:
      velocity: of the air at the height of the gust, (dim,), m/s. Differentiable.
      period: from one gust to the next, (), s, > 0. Differentiable.
    Returns: called as ``air(t, position)``, the velocity of the air at each particle, (particle, dim), m/s.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.Gust([4.0, 0.0], period=2.0)(1.0, jnp.zeros((1, 2))).tolist()
      [[4.0, 0.0]]

    Source: F. M. Hoblit, Gust Loads on Aircraft: Concepts and Applications, 1988 (the one-minus-cosine gust).
    """

    velocity: Parameter
    period: Parameter

    limits: ClassVar[dict[str, Any]] = {"velocity": ("", "m/s"), "period": ("> 0", "s")}
    axes: ClassVar[dict[str, int]] = {"velocity": 1, "period": 0}

    def __post_init__(self) -> None:
        store_as_float(self, "velocity", "period")
        check_limits(self)

    def __call__(self, t: Any, position: Array) -> Array:
        strength = (1 - jnp.cos(2 * jnp.pi * t / self.period)) / 2
        return jnp.broadcast_to((self.velocity * strength).astype(position.dtype), position.shape)


@component(positive=("speed", "size", "time"))
class Turbulence:
    """A random wind without sources, a sum of waves that drift: eddies of one size.

        w(p, t) = speed sqrt(2 / M) sum_m a_m cos(k_m.p / size + phase_m + f_m t / time),   a_m perpendicular to k_m

    Its divergence is 0 everywhere and its root mean square is ``speed``. `turbulence` draws the waves.

    Args:
      speed: root mean square, (), m/s. Differentiable.
      size: of the eddies, (), m, > 0. Differentiable.
      time: in which an eddy changes, (), s, > 0; inf freezes the field. Differentiable.
      waves: k, (wave, dim), of length near 1.
      amplitudes: a, (wave, dim), unit vectors across the waves.
      phases: (wave,), rad.
      frequencies: f, (wave,), rad.
    Returns: called as ``air(t, position)``, the velocity of the air at each particle, (particle, dim), m/s.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.turbulence(dim=3, speed=1.0, size=0.5, seed=1)(0.0, jnp.zeros((4, 3))).shape
      (4, 3)

    Source: R. H. Kraichnan, Diffusion by a random velocity field, Physics of Fluids 13, 1970.
    """

    speed: Parameter
    size: Parameter
    time: Parameter
    waves: Parameter
    amplitudes: Parameter
    phases: Parameter
    frequencies: Parameter

    limits: ClassVar[dict[str, Any]] = {"speed": (">= 0", "m/s"), "size": ("> 0", "m"), "time": ("> 0", "s")}
    may_be_infinite: ClassVar[tuple[str, ...]] = ("time",)
    axes: ClassVar[dict[str, int]] = {"speed": 0, "size": 0, "time": 0}

    def __post_init__(self) -> None:
        store_as_float(self, "speed", "size", "time", "waves", "amplitudes", "phases", "frequencies")
        check_limits(self)

    def __call__(self, t: Any, position: Array) -> Array:
        dtype = position.dtype
        waves, amplitudes = (self.waves / self.size).astype(dtype), self.amplitudes.astype(dtype)
        angle = position @ waves.T + (self.phases + self.frequencies * t / self.time).astype(dtype)
        return (self.speed * jnp.sqrt(2 / len(waves))).astype(dtype) * (jnp.cos(angle) @ amplitudes)


@says_what_to_write()
def turbulence(
    *, dim: int, speed: Any, size: Any, time: Any = float("inf"), modes: int = 12, seed: int = 0
) -> Turbulence:
    """A `Turbulence` with waves drawn from a seed.

    Args:
      dim: 2 or 3.
      speed: root mean square, (), m/s.
      size: of the eddies, (), m.
      time: in which an eddy changes, (), s; inf freezes the field.
      modes: the number of waves; the cost grows with it.
      seed: an integer; the same seed gives the same field.
    Returns: the `Turbulence`.
    Raises: ValueError, if dim is not 2 or 3, modes is not an integer above 0, or size, time or speed is out of range.
    Example:
      >>> import jeuler
      >>> jeuler.turbulence(dim=2, speed=1.0, size=0.5, modes=8).waves.shape
      (8, 2)

    Source: R. H. Kraichnan, Diffusion by a Random Velocity Field, Phys. Fluids 13, 1970 (a sum of random waves).
    """
    if checks.count("turbulence.dim", dim) not in (2, 3):
        raise ValueError(f"turbulence.dim must be 2 or 3, got {checks.shown(dim)}")
    modes, seed = checks.count("turbulence.modes", modes, least=1), checks.count("turbulence.seed", seed)
    random = np.random.default_rng(seed)
    waves = random.normal(size=(modes, dim))
    waves *= (random.uniform(0.7, 1.3, size=modes) / np.linalg.norm(waves, axis=1))[:, None]
    if dim == 2:
        across = np.stack([-waves[:, 1], waves[:, 0]], axis=1)
    else:
        across = np.cross(waves, random.normal(size=(modes, dim)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    phases, frequencies = random.uniform(0, 2 * np.pi, modes), random.normal(size=modes)
    return Turbulence(speed, size, time, *map(jnp.asarray, (waves, across, phases, frequencies)))


@component(positive=("core",))
class Vortex:
    """Air that turns about an axis, with a core that turns like a solid body.

        w = circulation / (2 pi r) (1 - exp(-r^2 / core^2)),   across the axis, r the distance to it

    Args:
      center: a point of the axis, (dim,), m, or a function of time. dim is 2 or 3. Differentiable.
      circulation: (), m^2/s; positive turns counterclockwise about the axis. Differentiable.
      core: radius of the core, (), m, > 0. Differentiable.
      axis: (3,), direction of the axis in space, any length; ignored in the plane. Differentiable.
    Returns: called as ``air(t, position)``, the velocity of the air at each particle, (particle, dim), m/s.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> w = jeuler.Vortex([0.0, 0.0], circulation=2 * jnp.pi, core=0.1)(0.0, jnp.array([[1.0, 0.0], [0.0, 0.0]]))
      >>> (abs(w) + 0.0).round(4).tolist()
      [[0.0, 1.0], [0.0, 0.0]]

    Source: H. Lamb, Hydrodynamics, 6th ed., 1932, sect. 334a (the Lamb-Oseen vortex).
    """

    center: MovingParameter
    circulation: Parameter
    core: Parameter
    axis: Parameter = default((0.0, 0.0, 1.0))

    limits: ClassVar[dict[str, Any]] = {"circulation": ("", "m^2/s"), "core": ("> 0", "m"), "axis": ("", "")}
    axes: ClassVar[dict[str, int]] = {"center": 1, "circulation": 0, "core": 0, "axis": 1}

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", moving("Vortex.center", self.center))
        store_as_float(self, "circulation", "core", "axis")
        check_limits(self)
        checks.points_somewhere("Vortex.axis", self.axis)

    def __call__(self, t: Any, position: Array) -> Array:
        dtype = position.dtype
        offset = position - at_time(self.center, t, dtype)
        if position.shape[1] == 2:
            across = jnp.stack([-offset[:, 1], offset[:, 0]], axis=1)
        else:
            axis = (self.axis / jnp.linalg.norm(self.axis)).astype(dtype)
            across = jnp.cross(axis, offset)
        square = jnp.sum(across**2, axis=1, keepdims=True) / self.core.astype(dtype) ** 2
        outside = square > 1e-6  # within, (1 - exp(-s)) / s is 1 to single precision's last digits
        shape = jnp.where(outside, -jnp.expm1(-square) / jnp.where(outside, square, 1), 1 - square / 2)
        return (self.circulation / (2 * jnp.pi * self.core**2)).astype(dtype) * shape * across
