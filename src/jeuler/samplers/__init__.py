"""Samplers: ``sampler(key, count) -> (count, ...)``, the random attributes of what is born."""

from jeuler.samplers.base import Choice, Normal, Uniform
from jeuler.samplers.places import Cone, FromDisc, FromLine, FromSphere, FromSurface

__all__ = [
    "Choice",
    "Cone",
    "FromDisc",
    "FromLine",
    "FromSphere",
    "FromSurface",
    "Normal",
    "Uniform",
]


def __dir__() -> list[str]:
    return __all__
