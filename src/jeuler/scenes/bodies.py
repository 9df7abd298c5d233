"""Scenes of bodies: hair, cloth, jelly. All particles live from beginning to end."""

# mypy: disable-error-code="arg-type"
# Components take numbers, lists and NumPy arrays, and keep JAX arrays: their annotations say what they keep.

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jeuler.colliders import Box, Plane, Sphere
from jeuler.effects import PrescribedMotion
from jeuler.effects.collisions import Collisions
from jeuler.forces import (
    Bending,
    Gravity,
    Gust,
    LinearDrag,
    ShapeMatching,
    Springs,
    StrandBending,
    StrandCore,
    strand_edges,
    turbulence,
)
from jeuler.particles import Scene
from jeuler.scenes.setup import Setup
from jeuler.state import ParticleState

DOWN = Gravity([0.0, 0.0, -9.81])


def curly_hair(strands: int = 64, nodes: int = 40, coils: float = 4.0) -> Setup:
    """Curls on a head that moves to and fro: stretch, bending and core springs on each strand."""
    random = np.random.default_rng(2)
    around = np.linspace(0, 2 * np.pi, strands, endpoint=False) + random.uniform(-0.05, 0.05, strands)
    up = random.uniform(0.05, 0.75, strands)
    out = np.stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)], axis=1)
    s = np.linspace(0, 1, nodes)[None, :, None]
    turn = 2 * np.pi * coils * s + random.uniform(0, 2 * np.pi, (strands, 1, 1))
    swell = 0.05 * np.minimum(1, 4 * s)
    drape = 0.30 * out[:, None] + 0.10 * s * out[:, None] * [1, 1, 0] - [0, 0, 0.62] * s
    rest = drape + swell * np.concatenate([np.cos(turn), np.sin(turn), 0 * turn], axis=2)
    index = np.arange(strands * nodes).reshape(strands, nodes)
    edges = strand_edges(index)
    flat = rest.reshape(-1, 3)
    length = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)

    def nod(t):
        return jnp.stack([0.22 * jnp.sin(5.0 * t), 0.0 * t, 0.04 * jnp.sin(10.0 * t)])

    roots = index[:, :2].ravel()
    start = jnp.asarray(flat[roots])
    head = Sphere(lambda t: nod(t), 0.28)
    forces = (
        DOWN,
        Springs(edges, ks=1500.0, kd=0.3, rest_length=length),
        StrandBending(index, rest, stiffness=60.0, damping=0.05, smoothing=0.25),
        StrandCore(index, rest, stiffness=200.0, damping=0.1, smoothing=0.25),
        LinearDrag(0.003),
    )
    effects = (PrescribedMotion(roots, lambda t: start + nod(t)), Collisions((head,), friction=0.2))
    brown = np.repeat(random.uniform(0.7, 1.3, (strands, 1)) * [[0.42, 0.24, 0.12]], nodes, axis=0)
    state = ParticleState(flat, 0 * flat, mass=0.003, color=brown, size=np.full(len(flat), 0.009))
    camera = {"center": [0.0, 0.0, -0.16], "width": 1.6, "elevation": 6.0}
    return Setup(Scene(forces, effects), state, 5e-4, 4000, 40, camera, frame=-1)


def cloth_on_sphere(side: int = 32) -> Setup:
    """A cloth that falls over a ball while a gusting wind pulls at it."""
    grid = np.arange(side * side).reshape(side, side)
    along = np.concatenate([np.stack([grid[:-1], grid[1:]], -1).reshape(-1, 2),
                            np.stack([grid[:, :-1], grid[:, 1:]], -1).reshape(-1, 2)])  # fmt: skip
    across = np.concatenate([np.stack([grid[:-1, :-1], grid[1:, 1:]], -1).reshape(-1, 2),
                             np.stack([grid[:-1, 1:], grid[1:, :-1]], -1).reshape(-1, 2)])  # fmt: skip
    lines = np.concatenate([np.stack([grid[:-2], grid[1:-1], grid[2:]], -1).reshape(-1, 3),
                            np.stack([grid[:, :-2], grid[:, 1:-1], grid[:, 2:]], -1).reshape(-1, 3)])  # fmt: skip
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    cloth = np.stack([x, y, 0.75 + 0 * x], axis=-1).reshape(-1, 3)
    edges, h = np.concatenate([along, across]), 2 / (side - 1)
    length = np.where(np.arange(len(edges)) < len(along), h, np.sqrt(2) * h)
    air = (Gust([2.5, 1.0, 0.0], period=1.5), turbulence(dim=3, speed=1.0, size=0.5, time=0.5))
    forces = (
        DOWN,
        Springs(edges, ks=250.0, kd=0.05, rest_length=length),
        Bending(lines, stiffness=1e-4),
        LinearDrag(0.004, air=air),
    )
    ball = Collisions(
        (Sphere([0.0, 0.0, 0.0], 0.6), Plane([0.0, 0.0, -0.8], [0.0, 0.0, 1.0])), radius=0.02, friction=0.5
    )
    camera = {"center": [0.0, 0.0, 0.0], "width": 2.4, "elevation": 22.0}
    return Setup(Scene(forces, (ball,)), ParticleState(cloth, 0 * cloth, mass=0.004), 1e-3, 1500, 15, camera)


def jelly_on_stairs(side: int = 6) -> Setup:
    """A cube of jelly that tumbles down stairs and keeps its shape."""
    cube = 0.16 * (
        np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) - (side - 1) / 2
    )
    apart = np.linalg.norm(cube[:, None] - cube[None], axis=-1)
    surface = np.abs(cube).max(axis=1) > 0.16 * (side - 1) / 2 - 1e-6
    i, j = np.nonzero(np.triu(np.isclose(apart, 0.16)) & surface[:, None] & surface)
    tilt = np.array([[0.8, 0.0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    start = cube @ tilt.T + [-1.3, 0.0, 1.5]
    stairs = tuple(Box([-1.5 + 0.9 * k, 0.0, -0.45 * k - 1.0], [0.45, 1.4, 1.0]) for k in range(3))
    landing = Box([2.4, 0.0, -2.35], [1.65, 1.4, 1.0])
    forces = (
        DOWN,
        ShapeMatching(range(side**3), cube, stiffness=120.0, damping=0.6),
        Springs(np.stack([i, j], axis=1), ks=60.0, kd=0.2, rest_length=0.16),
    )
    velocity = np.tile([0.9, 0.0, 0.0], (side**3, 1))
    contact = Collisions((*stairs, landing), restitution=0.2, friction=0.25)
    color = np.where(surface[:, None], [0.85, 0.2, 0.45], [0.95, 0.5, 0.6])
    state = ParticleState(start, velocity, mass=0.05, color=color, size=np.full(side**3, 0.09))
    camera = {"center": [1.1, 0.0, -0.5], "width": 6.4, "azimuth": -70.0, "elevation": 14.0}
    return Setup(Scene(forces, (contact,)), state, 2e-3, 1000, 20, camera, frame=22)
