"""Scenes of bodies: hair, cloth, jelly. All particles live from beginning to end."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.contact import Box, Collisions, PenaltyContact, Plane, Sphere
from jeuler.effects import PrescribedMotion
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
from jeuler.particles import ParticleState, Scene
from jeuler.scenes.setup import Setup
from jeuler.scenes.shapes import cube, curls, square_cloth

DOWN = Gravity([0.0, 0.0, -9.81])
STUDIO = {"background": "#cfd4d6", "sky": "#8fa1ad"}


def nod(t: Any) -> Array:
    """The way of a head that is shaken, m."""
    return jnp.stack([0.12 * jnp.sin(5.0 * t), 0.0 * t, 0.02 * jnp.sin(10.0 * t)])


def curly_hair(strands: int = 2000, guides: int = 200, nodes: int = 40) -> Setup:
    """Curls on a head that is shaken: guides with stretch, bending and core springs, and strands about them."""
    from jeuler.plotting.hair import Hair

    rest = curls(guides, nodes, length=0.6, head=0.28, curl=0.028, coils=6.0, face=2.2)
    index = np.arange(guides * nodes).reshape(guides, nodes)
    edges, roots, flat = strand_edges(index), index[:, :2].ravel(), rest.reshape(-1, 3)
    start = jnp.asarray(flat[roots])
    forces = (
        DOWN,
        Springs(edges, ks=1500.0, kd=0.3, rest_length=np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)),
        StrandBending(index, rest, stiffness=30.0, damping=0.05, smoothing=0.3),
        StrandCore(index, rest, stiffness=200.0, damping=0.1, smoothing=0.3),
        PenaltyContact(Sphere(nod, 0.28), ks=100.0, kd=0.1, radius=0.008),
        LinearDrag(0.01),
    )
    tint = np.random.default_rng(2).uniform(0.8, 1.25, (guides, 1)) * [[0.46, 0.23, 0.10]]
    state = ParticleState(flat, 0 * flat, mass=0.003, color=np.repeat(tint, nodes, axis=0))
    camera = {"center": [0.0, 0.0, -0.2], "width": 2.1, "elevation": 8.0, "azimuth": -40.0}
    hair = Hair.grown(index, rest, strands, spread=0.035)
    look = {"links": "color", "width": 1.0, "particles": False, "hair": hair, "solids": "#3b2a22"} | STUDIO
    scene = Scene(forces, (PrescribedMotion(roots, lambda t: start + nod(t)),))
    return Setup(scene, state, 5e-4, 4000, 40, camera, look, frame=86)


def cloth_on_sphere(side: int = 40) -> Setup:
    """A cloth that falls over a ball while a gusting wind pulls at it."""
    cloth = square_cloth(side, width=2.0)
    air = (Gust([2.5, 1.0, 0.0], period=1.5), turbulence(dim=3, speed=1.0, size=0.5, time=0.5))
    forces = (
        DOWN,
        Springs(cloth.edges, ks=250.0, kd=0.05, rest_length=cloth.length),
        Bending(cloth.lines, stiffness=1e-4),
        LinearDrag(0.004, air=air),
    )
    solids = (Sphere([0.0, 0.0, 0.0], 0.6), Plane([0.0, 0.0, -0.8], [0.0, 0.0, 1.0]))
    start = cloth.position + np.array([0.0, 0.0, 0.75])
    check = np.add.outer(np.arange(side) // 4 % 2, np.arange(side) // 4 % 2).reshape(-1)
    color = np.array([[0.93, 0.88, 0.80], [0.75, 0.30, 0.27], [0.52, 0.07, 0.09]])[check]
    state = ParticleState(start, 0 * start, mass=4.0 / side**2, color=color)
    camera = {"center": [0.1, 0.0, -0.12], "width": 3.0, "elevation": 20.0, "azimuth": -70.0}
    look = {"faces": cloth.faces, "links": None, "particles": False} | STUDIO
    scene = Scene(forces, (Collisions(solids, radius=0.02, friction=0.5),))
    return Setup(scene, state, 1e-3, 1500, 15, camera, look)


def jelly_on_stairs(side: int = 6) -> Setup:
    """A cube of jelly that tumbles down stairs and keeps its shape."""
    jelly = cube(side, width=0.8)
    tilt = np.array([[0.8, 0.0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    start, particles = jelly.position @ tilt.T + [-1.3, 0.0, 1.3], side**3
    stairs = [Box([-1.5 + 0.9 * k, 0.0, -0.45 * k - 1.0], [0.45, 1.4, 1.0]) for k in range(3)]
    landing = Box([2.85, 0.0, -2.35], [2.1, 1.4, 1.0])
    forces = (
        DOWN,
        ShapeMatching(range(particles), jelly.position, stiffness=120.0, damping=0.6),
        Springs(jelly.edges, ks=320.0, kd=0.6, rest_length=jelly.length),
    )
    contact = Collisions((*stairs, landing), restitution=0.2, friction=0.25)
    velocity, pink = np.tile([0.9, 0.0, 0.0], (particles, 1)), np.tile([0.9, 0.25, 0.5], (particles, 1))
    state = ParticleState(start, velocity, mass=3.2 / particles, color=pink, opacity=np.full(particles, 0.72))
    camera = {"center": [0.35, 0.0, 0.0], "width": 4.6, "azimuth": -62.0, "elevation": 16.0}
    look = {"faces": jelly.faces, "links": None, "particles": False, "solids": "#b9a88f"} | STUDIO
    return Setup(Scene(forces, (contact,)), state, 2e-3, 1000, 20, camera, look, frame=22)
