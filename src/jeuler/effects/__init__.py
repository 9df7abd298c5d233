"""Effects: ``effect(t, dt, state, key) -> state`` at each step, in the order written. One file a family."""

from jeuler.effects.appearance import OverLife, SpeedLimit
from jeuler.effects.lifecycle import Death, DeathOnContact, DeathOutside, Emitter, Lifetime
from jeuler.effects.prescribed import PrescribedMotion, SampledPath

__all__ = [
    "Death",
    "DeathOnContact",
    "DeathOutside",
    "Emitter",
    "Lifetime",
    "OverLife",
    "PrescribedMotion",
    "SampledPath",
    "SpeedLimit",
]


def __dir__() -> list[str]:
    return __all__
