"""A sensor: an observation that is late, scaled and shifted; and the user's own functions as observations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, default
from jeuler._core.component import as_component, component, store_as_float
from jeuler._core.signatures import signature_of
from jeuler.observing.quantities import Acceleration, Position, Velocity
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

BY_NAME = {"position": Position, "velocity": Velocity, "acceleration": Acceleration}
TIME_NAMES = ("t", "time")


@component(parameters=("delay", "gain", "bias"))
class Sensor:
    """A sensor that is late, has a gain, and a bias.

        reading(t) = gain observation(t - delay) + bias

    The three are unknowns of ``fit_springs`` where ``parameters`` names them.

    Args:
      observation: what it measures, as ``fit_springs(observe=...)`` takes it.
      delay: (), s.
      gain: (), or a shape that broadcasts to the reading.
      bias: the same, in the unit of the reading.
    Returns: called as ``(t, scene, state)``, the reading of the state that it is given, as one that is not late.
    Raises: ValueError, if the observation is no function, or a number is not finite.
    Example:
      >>> import jeuler
      >>> state = jeuler.ParticleState([[2.0]], [[3.0]])
      >>> sensor = jeuler.observing.Sensor("velocity", gain=10.0, bias=0.5)
      >>> sensor(0.0, jeuler.Scene(), state).tolist()
      [[30.5]]
    """

    observation: Any
    delay: Parameter = default(0.0)
    gain: Parameter = default(1.0)
    bias: Parameter = default(0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observation", as_observation(self.observation))
        with jax.ensure_compile_time_eval():  # numbers are values also where the sensor is made while tracing
            store_as_float(self, "delay", "gain", "bias")
        checks.number("Sensor.delay", self.delay)
        for name in ("gain", "bias"):
            checks.finite(f"Sensor.{name}", getattr(self, name))

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Array:
        shown = jnp.asarray(self.observation(t, scene, state))
        return self.gain.astype(shown.dtype) * shown + self.bias.astype(shown.dtype)

    def check(self, scene: Scene, particles: int, dim: int) -> None:
        if hasattr(self.observation, "check"):
            self.observation.check(scene, particles, dim)


@component(static=("of_time", "of_scene"))
class OfTheUser:
    """A function of the user's: of (scene, state), of (t, state), or of (t, scene, state)."""

    function: Any
    of_time: bool
    of_scene: bool

    quantity = "observation"
    unit = ""

    def __call__(self, t: Any, scene: Scene, state: ParticleState) -> Any:
        before = ((t,) if self.of_time else ()) + ((scene,) if self.of_scene else ())
        return self.function(*before, state)


def as_observation(observe: Any) -> Any:
    """An observation from its name, a function or a ready-made one, or one ValueError."""
    if isinstance(observe, str) and observe in BY_NAME:
        return BY_NAME[observe]()
    expected = (
        f"observe must be {', '.join(map(repr, BY_NAME))}, one of jeuler.observing, or a function of (scene, state) or "
        f"(t, state)"
    )
    if isinstance(observe, str) or not callable(observe) or isinstance(observe, type):
        hint = f"; write {observe.__name__}(...)" if isinstance(observe, type) else ""
        raise ValueError(f"{expected}, got {checks.shown(observe)}{hint}")
    if type(observe).__module__.startswith("jeuler.observing"):
        return observe
    signature = signature_of(observe)
    names = [] if signature is None else [p.name for p in signature.parameters.values() if p.default is p.empty]
    if len(names) not in (2, 3):
        raise ValueError(f"{expected}, got {checks.shown(observe)} of {len(names)} arguments")
    of_time = len(names) == 3 or names[0] in TIME_NAMES
    return OfTheUser(as_component(observe), of_time, len(names) == 3 or not of_time)
