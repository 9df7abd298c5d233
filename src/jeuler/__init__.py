"""jeuler: differentiable Euler integration of springs, particles and ODEs in JAX."""

from jeuler.effects import PrescribedMotion, SampledPath
from jeuler.fitting import Fit, SpringFit, fit, fit_springs
from jeuler.forces import Gravity, QuadraticDrag, Springs
from jeuler.methods import euler_step, heun_step, rk4_step, symplectic_euler_step
from jeuler.particles import ParticleState, Scene, simulate
from jeuler.solve import Solution, solve
from jeuler.trajectory import Trajectory, read_trajectory

__version__ = "0.1.0"

__all__ = [
    "Fit",
    "Gravity",
    "ParticleState",
    "PrescribedMotion",
    "QuadraticDrag",
    "SampledPath",
    "Scene",
    "Solution",
    "SpringFit",
    "Springs",
    "Trajectory",
    "euler_step",
    "fit",
    "fit_springs",
    "heun_step",
    "read_trajectory",
    "rk4_step",
    "simulate",
    "solve",
    "symplectic_euler_step",
]
