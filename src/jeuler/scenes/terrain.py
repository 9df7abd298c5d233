"""A crowd: thousands of agents that run for a goal over hills, around rocks, without stepping on each other."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.contact import Sphere
from jeuler.effects import Neighbours, SpeedLimit
from jeuler.forces import PointAttractor, SoftRepulsion
from jeuler.particles import ParticleState, Scene, uses
from jeuler.scenes.setup import Setup

GOAL = np.array([60.0, 0.0])
SLOW, FAST = np.array([0.1, 0.2, 0.55]), np.array([0.9, 0.3, 0.1])  # colours
ROCKS = ((5.0, 6.0, 2.5), (14.0, -9.0, 3.5), (26.0, 2.0, 2.0))  # x, y, radius, m
TALL, WIDTH = 1.8, 0.55  # of an agent, m


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


def pushed_out(x: Array, t: Any = 0.0) -> Array:
    """Places (agent, 2) out of the rocks and half a metre from them, on the straight way out."""
    for rock_x, rock_y, radius in ROCKS:
        d = x - jnp.array([rock_x, rock_y], x.dtype)
        r = jnp.linalg.norm(d, axis=1, keepdims=True)
        x = x + jnp.maximum(radius + 0.5 - r, 0) * d / jnp.maximum(r, 1e-6)
    return x


@uses(sets=("color",), reads=("neighbours", "has_neighbours"))
def on_the_ground(t: Any, dt: Any, state: ParticleState, key: Any) -> ParticleState:
    """Feet on the land, out of the rocks, no two nearer than a body's width; the redder, the faster it runs."""
    x, v = state.position[:, :2], state.velocity
    who, is_one = jnp.maximum(state.neighbours, 0), state.neighbours >= 0
    for _ in range(6):
        d = x[:, None] - x[who]
        r = jnp.sqrt(jnp.maximum(jnp.sum(d**2, axis=2), 1e-6))
        share = jnp.where(is_one, 0.45 * jnp.maximum(WIDTH - r, 0) / r, 0)
        x = pushed_out(x + jnp.sum(share[..., None] * d, axis=1))
    speed = jnp.clip(jnp.linalg.norm(v[:, :2], axis=1, keepdims=True) / 8 * 2 - 1, 0, 1)
    position = jnp.concatenate([x, height(x[:, :1], x[:, 1:]) + 0.5 * TALL], axis=1)
    return state.replace(position=position, velocity=v.at[:, 2].set(0.0), color=SLOW + speed * (FAST - SLOW))


ROCK_SOLIDS = tuple(Sphere([x, y, float(height(x, y))], radius) for x, y, radius in ROCKS)
on_the_ground.colliders = (land, *ROCK_SOLIDS)  # type: ignore[attr-defined]  # drawn with the scene


def charge(agents: int = 5000) -> Setup:
    """A charge across a terrain: a goal, a speed limit, rocks that nobody enters, neighbours that nobody hits."""
    random, rows = np.random.default_rng(0), round(np.sqrt(agents))
    place = np.stack([np.arange(agents) // rows, np.arange(agents) % rows], axis=1) - [rows, rows / 2]
    place = place * 0.9 + random.uniform(-0.15, 0.15, (agents, 2)) - [8.0, 0.0]
    position = np.concatenate([place, np.asarray(height(*place.T))[:, None] + 0.5 * TALL], axis=1)
    near = Neighbours(cutoff=1.2, skin=0.8, capacity=48, cell_capacity=48)
    rocks = tuple(PointAttractor([x, y, float(height(x, y))], -60.0 * r, softening=r) for x, y, r in ROCKS)
    limit = SpeedLimit(random.normal(7.0, 0.8, agents).clip(4.0, 9.0))
    apart = SoftRepulsion(near, diameter=1.1, ks=90.0, kd=4.0)
    scene = Scene((run_to_goal, apart, *rocks), (limit, near, on_the_ground))
    state = ParticleState(position, 0 * position, color=np.tile(SLOW, (agents, 1)), size=np.full(agents, TALL))
    camera = {"center": [8.0, 0.0, 1.0], "width": 34.0, "elevation": 9.0, "azimuth": 28.0}
    look = {"particles": "runners", "background": "#e8d6b8", "sky": "#6f93b8", "solids": "#a58b62", "dust": "#d8c29a"}
    return Setup(scene, state, 0.05, 240, 4, camera, look | {"haze": 0.5}, frame=28)
