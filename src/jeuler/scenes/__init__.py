"""Example scenes, each a short function in the library's own terms: read one, change it, make it yours.

    from jeuler import scenes
    film = scenes.fountain().film("fountain.gif")

They are part of the package, so that notebooks, tests and people all run the same code.
"""

from jeuler.scenes.bodies import cloth_on_sphere, curly_hair, jelly_on_stairs
from jeuler.scenes.pools import fireworks, fountain, rain_on_pegs, smoke_column
from jeuler.scenes.setup import Setup
from jeuler.scenes.swarms import dam_break, flock
from jeuler.scenes.terrain import charge

ALL = (
    fountain, smoke_column, fireworks, curly_hair, cloth_on_sphere, jelly_on_stairs, charge, rain_on_pegs, flock,
    dam_break,
)  # fmt: skip

__all__ = [
    "ALL",
    "Setup",
    "charge",
    "cloth_on_sphere",
    "curly_hair",
    "dam_break",
    "fireworks",
    "flock",
    "fountain",
    "jelly_on_stairs",
    "rain_on_pegs",
    "smoke_column",
]


def __dir__() -> list[str]:
    return __all__
