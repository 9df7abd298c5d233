"""Effects: ``effect(t, dt, previous, state, key) -> state`` at each step, in the order written."""

from jeuler.effects.appearance import OverLife, SpeedLimit
from jeuler.effects.births import Emitter
from jeuler.effects.breaking import Breaking
from jeuler.effects.deaths import Death, DeathOnContact, DeathOutside, Lifetime
from jeuler.effects.distance import DistanceLinks
from jeuler.effects.neighbours import Neighbours
from jeuler.effects.offspring import SubEmitter
from jeuler.effects.prescribed import PrescribedMotion, SampledPath
from jeuler.effects.trail import Trail

__all__ = [
    "Breaking",
    "Death",
    "DeathOnContact",
    "DeathOutside",
    "DistanceLinks",
    "Emitter",
    "Lifetime",
    "Neighbours",
    "OverLife",
    "PrescribedMotion",
    "SampledPath",
    "SpeedLimit",
    "SubEmitter",
    "Trail",
]


def __dir__() -> list[str]:
    return __all__
