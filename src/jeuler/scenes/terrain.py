"""A crowd: thousands of agents that run for a goal over hills, around rocks, without stepping on each other."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.contact import Sphere
from jeuler.effects import SpeedLimit
from jeuler.forces import PointAttractor
from jeuler.particles import ParticleState, Scene, uses
from jeuler.scenes.setup import Setup

GOAL = np.array([60.0, 0.0])
SLOW, FAST = np.array([0.1, 0.2, 0.55]), np.array([0.9, 0.3, 0.1])  # colours
ROCKS = ((5.0, 6.0), (14.0, -9.0), (26.0, 2.0))


def height(x: Any, y: Any) -> Array:
    """The land, m."""
    return 2.0 * jnp.sin(x / 9) * jnp.cos(y / 11) + 1.2 * jnp.sin(x / 17 + y / 13)


def land(t: Any, point: Array) -> Array:
    """The signed distance to the land, nearly: its slopes are gentle."""
    return point[2] - height(point[0], point[1])


def run_to_goal(t: Any, position: Array, velocity: Array, mass: Array) -> Array:
    """Each agent steers for 6 m/s towards the goal, within half a second."""
    way = GOAL - position[:, :2]
    wanted = 6.0 * way / jnp.linalg.norm(way, axis=1, keepdims=True)
    return jnp.pad((wanted - velocity[:, :2]) / 0.5, ((0, 0), (0, 1)))


def keep_apart(t: Any, position: Array, velocity: Array, mass: Array) -> Array:
    """Away from where it is crowded: down the slope of the number of agents per cell, on a grid of 1.5 m."""
    cell, cells = 1.5, 96
    place = position[:, :2].T / cell + cells / 2
    corner = jnp.clip(jnp.floor(place).astype(int), 0, cells - 2)
    part = place - corner
    crowd = jnp.zeros((cells, cells), position.dtype)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):  # each agent counts at the four corners of its cell
        share = jnp.abs(1 - i - part[0]) * jnp.abs(1 - j - part[1])
        crowd = crowd.at[corner[0] + i, corner[1] + j].add(share)
    for axis in (0, 1, 0, 1):  # smoothed, or agents would line up with the cells
        crowd = (jnp.roll(crowd, 1, axis) + 2 * crowd + jnp.roll(crowd, -1, axis)) / 4
    slope = [jax.scipy.ndimage.map_coordinates(x, list(place), order=1) for x in jnp.gradient(crowd)]
    return jnp.stack([-5.0 * slope[0], -5.0 * slope[1], jnp.zeros(len(position), position.dtype)], axis=1)


@uses(sets=("color",))
def on_the_ground(t: Any, dt: Any, state: ParticleState, key: Any) -> ParticleState:
    """Feet on the land; an agent is the redder the faster it runs."""
    p, v = state.position, state.velocity
    speed = jnp.clip(jnp.linalg.norm(v[:, :2], axis=1, keepdims=True) / 8 * 2 - 1, 0, 1)
    position = p.at[:, 2].set(height(p[:, 0], p[:, 1]) + 0.3)
    return state.replace(position=position, velocity=v.at[:, 2].set(0.0), color=SLOW + speed * (FAST - SLOW))


ROCK_SOLIDS = tuple(Sphere([x, y, float(height(x, y))], 2.0) for x, y in ROCKS)
on_the_ground.colliders = (land, *ROCK_SOLIDS)  # type: ignore[attr-defined]  # drawn with the scene


def charge(agents: int = 5000) -> Setup:
    """A charge across a terrain: goal, speed limit, rocks and neighbours to avoid."""
    random = np.random.default_rng(0)
    place = np.stack([random.uniform(-50, -20, agents), random.uniform(-28, 28, agents)], axis=1)
    position = np.concatenate([place, np.asarray(height(*place.T))[:, None] + 0.3], axis=1)
    rocks = tuple(PointAttractor([x, y, float(height(x, y))], -160.0, softening=2.0) for x, y in ROCKS)
    limit = random.normal(7.0, 0.8, agents).clip(4.0, 9.0)
    scene = Scene((run_to_goal, keep_apart, *rocks), (SpeedLimit(limit), on_the_ground))
    state = ParticleState(position, 0 * position, color=np.tile(SLOW, (agents, 1)), size=np.full(agents, 0.6))
    camera = {"center": [4.0, 0.0, 0.0], "width": 112.0, "elevation": 32.0, "azimuth": -62.0}
    return Setup(scene, state, 0.05, 240, 4, camera, frame=32)
