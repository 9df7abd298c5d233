"""Effects: ``effect(t, dt, state, key) -> state`` at each step, in the order written. One file a family."""

from jeuler.effects.appearance import OverLife, SpeedLimit
from jeuler.effects.collisions import Collisions
from jeuler.effects.lifecycle import Death, DeathOnContact, DeathOutside, Emitter, Lifetime
from jeuler.effects.places import Cone, FromDisc, FromLine, FromSphere, FromSurface
from jeuler.effects.prescribed import PrescribedMotion, SampledPath
from jeuler.effects.samplers import Choice, Normal, Uniform

__all__ = [
    "Choice",
    "Collisions",
    "Cone",
    "Death",
    "DeathOnContact",
    "DeathOutside",
    "Emitter",
    "FromDisc",
    "FromLine",
    "FromSphere",
    "FromSurface",
    "Lifetime",
    "Normal",
    "OverLife",
    "PrescribedMotion",
    "SampledPath",
    "SpeedLimit",
    "Uniform",
]
