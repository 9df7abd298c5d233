"""Contact with solid shapes and between balls: at the time of impact, or as a force."""

from jeuler.contact.colliders import Box, Plane, Sphere
from jeuler.contact.collisions import Collisions
from jeuler.contact.grid import GridDistance
from jeuler.contact.penalty import PenaltyContact

__all__ = [
    "Box",
    "Collisions",
    "GridDistance",
    "PenaltyContact",
    "Plane",
    "Sphere",
]


def __dir__() -> list[str]:
    return __all__
