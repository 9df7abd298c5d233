"""Particles, the scene of forces and effects that moves them, and the run."""

from jeuler.particles._export import export
from jeuler.particles._simulate import simulate
from jeuler.particles.divided import Division, divide
from jeuler.particles.fields import uses
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, empty_pool

__all__ = [
    "Division",
    "ParticleState",
    "Scene",
    "divide",
    "empty_pool",
    "export",
    "simulate",
    "uses",
]


def __dir__() -> list[str]:
    return __all__
