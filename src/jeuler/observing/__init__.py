"""Observations: what a sensor shows of a scene, ``observation(t, scene, state)``, for ``fit_springs(observe=...)``."""

from jeuler.observing.quantities import Acceleration, Angle, Distance, Position, Projection, SpringForce, Velocity
from jeuler.observing.sensors import Sensor

__all__ = ["Acceleration", "Angle", "Distance", "Position", "Projection", "Sensor", "SpringForce", "Velocity"]


def __dir__() -> list[str]:
    return __all__
