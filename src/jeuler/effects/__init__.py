"""Effects: ``effect(t, dt, state, key) -> state`` after each step, in the order written. One file a family."""

from jeuler.effects.collisions import Collisions
from jeuler.effects.prescribed import PrescribedMotion, SampledPath

__all__ = ["Collisions", "PrescribedMotion", "SampledPath"]
