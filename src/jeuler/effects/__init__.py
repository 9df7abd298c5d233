"""Effects: ``effect(t, dt, state, key) -> state`` after each step, in the order written. One file a family."""

from jeuler.effects.prescribed import PrescribedMotion, SampledPath

__all__ = ["PrescribedMotion", "SampledPath"]
