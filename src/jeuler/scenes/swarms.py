"""Scenes of particles that see each other: a flock, and water."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.contact import Collisions, Plane
from jeuler.effects import Neighbours, SpeedLimit
from jeuler.forces import Flocking, Fluid, Gravity, LinearDrag, turbulence
from jeuler.particles import ParticleState, Scene, uses
from jeuler.scenes.setup import Setup


def home(t: Any, position: Array, velocity: Array, mass: Array) -> Array:
    """Birds turn back to their tree, and fly at 12 m/s as they like to."""
    away = position - jnp.array([0.0, 0.0, 25.0], position.dtype)
    speed = jnp.linalg.norm(velocity, axis=1, keepdims=True)
    return -0.12 * away * jnp.array([1.0, 1.0, 3.0], position.dtype) + 1.0 * velocity * (12.0 / (speed + 1e-3) - 1)


def flock(birds: int = 4000) -> Setup:
    """Starlings at dusk: each keeps its distance from those it sees, goes their way and stays with them."""
    random = np.random.default_rng(0)
    position = random.normal(0, 1, (birds, 3)) * [10, 10, 4] + [0, 0, 25]
    around = np.stack([-position[:, 1], position[:, 0], 0 * position[:, 0]], axis=1)
    velocity = 10 * around / np.linalg.norm(around, axis=1, keepdims=True) + random.normal(0, 2, (birds, 3))
    near = Neighbours(cutoff=3.5, skin=1.5, capacity=96, cell_capacity=96)
    boids = Flocking(near, separation=9.0, alignment=2.0, cohesion=1.5)
    wind = LinearDrag(0.25, air=turbulence(dim=3, speed=4.0, size=12.0, time=3.0))
    scene = Scene((boids, home, wind), (near, SpeedLimit(18.0)))
    state = ParticleState(position, velocity, color=np.tile([0.05, 0.05, 0.07], (birds, 1)), size=np.full(birds, 1.1))
    camera = {"center": [0.0, 0.0, 27.0], "width": 95.0, "elevation": -6.0, "azimuth": -60.0}
    look = {"particles": "birds", "background": "#f2a65e", "sky": "#3d4f7c", "haze": 0.15}
    return Setup(scene, state, 0.05, 240, 4, camera, look, frame=30)


@uses(sets=("color",))
def foam(t: Any, dt: Any, state: ParticleState, key: Any) -> ParticleState:
    """Water is the whiter, the faster it is."""
    speed = jnp.clip(jnp.linalg.norm(state.velocity, axis=1, keepdims=True) / 3.0, 0, 1)
    deep, white = jnp.array([0.05, 0.25, 0.55]), jnp.array([0.85, 0.95, 1.0])
    return state.replace(color=(deep + speed**1.5 * (white - deep)).astype(state.position.dtype))


def dam_break(across: int = 8, spacing: float = 0.05) -> Setup:
    """A dam breaks: a block of water, held by nothing, falls and runs along a trough."""
    n = np.array([2 * across, across, 2 * across])
    place = np.stack(np.meshgrid(*[np.arange(k) for k in n], indexing="ij"), axis=-1).reshape(-1, 3)
    position = spacing * (place + 0.5 + np.random.default_rng(0).uniform(-0.05, 0.05, place.shape))
    long, wide = 3.5 * n[0] * spacing, n[1] * spacing
    near = Neighbours(cutoff=2 * spacing, skin=0.5 * spacing, capacity=80, cell_capacity=60)
    water = Fluid(near, mass=1000 * spacing**3, density=1000.0, stiffness=150.0, viscosity=2.0)

    def walls(t, point):
        x, y, _ = point
        return jnp.minimum(jnp.minimum(x, long - x), jnp.minimum(y, wide - y))

    walls.drawn = False  # type: ignore[attr-defined]  # of glass: the one in front would hide all
    floor = Plane([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    trough = Collisions((floor, walls), radius=spacing / 2, restitution=0.1)
    state = ParticleState(position, 0 * position, mass=1000 * spacing**3, size=np.full(len(place), 1.6 * spacing))
    middle = [long / 2, wide / 2, 0.1 * long]
    camera = {"center": middle, "width": 1.12 * long, "elevation": 20.0, "azimuth": -78.0}
    look = {"background": "#c9d3da", "sky": "#7d93a6", "solids": "#5f6a72"}
    scene = Scene((Gravity([0.0, 0.0, -9.81]), water), (near, trough, foam))
    return Setup(scene, state, 2e-3, 400, 10, camera, look, frame=34)
