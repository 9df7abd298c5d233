"""Scenes of particles that are born and die: water, smoke, rain."""

from __future__ import annotations

import jax.numpy as jnp

from jeuler.contact import Collisions, Plane
from jeuler.effects import DeathOutside, Emitter, Lifetime, OverLife
from jeuler.forces import Gravity, Gust, LinearDrag, Vortex, turbulence
from jeuler.particles import Scene, empty_pool, uses
from jeuler.samplers import Cone, FromDisc, FromLine, Normal, Uniform
from jeuler.scenes.setup import Setup


def fountain() -> Setup:
    """A fountain: a jet of drops that a gusting wind carries off and the ground throws back."""
    jet = Emitter(
        rate=1500.0,
        position=FromDisc([0.0, 0.0, 0.1], radius=0.06),
        velocity=Cone([0.0, 0.0, 1.0], speed=Uniform(6.4, 7.2), angle=0.14),
        lifetime=Uniform(2.2, 2.8),
        max_births=40,
    )
    air = (Gust([3.0, 0.0, 0.0], period=4.0), turbulence(dim=3, speed=0.6, size=0.5, time=1.0))
    ground = Collisions((Plane([0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]),), restitution=0.3, friction=0.2)
    blue = OverLife("color", [[0.95, 0.98, 1.0], [0.45, 0.7, 0.95], [0.2, 0.4, 0.8]])
    fade = OverLife("opacity", [0.95, 0.7, 0.0], times=[0.0, 0.8, 1.0])
    grow = OverLife("size", [0.035, 0.06])
    scene = Scene((Gravity([0.0, 0.0, -9.81]), LinearDrag(0.15, air=air)), (jet, Lifetime(), ground, blue, fade, grow))
    camera = {"center": [0.45, 0.0, 1.25], "width": 4.4, "azimuth": -90.0, "elevation": 10.0}
    return Setup(scene, empty_pool(4000, dim=3), 0.02, 200, 2, camera, {"background": "#10151f"})


def smoke_column() -> Setup:
    """Smoke that rises while it is hot, turns about a vortex, spreads and fades."""

    @uses(reads=("age",))
    def buoyancy(t, position, velocity, mass, age):
        return (6.0 * jnp.exp(-age / 1.2))[:, None] * jnp.array([0.0, 0.0, 1.0], position.dtype)

    fire = Emitter(
        rate=900.0, position=FromDisc([0.0, 0.0, 0.0], radius=0.22), velocity=Normal([0.0, 0.0, 0.5], 0.15),
        lifetime=Uniform(2.5, 4.0), max_births=40,
    )  # fmt: skip
    air = (Vortex([0.0, 0.0, 0.0], circulation=5.0, core=0.5), turbulence(dim=3, speed=0.45, size=0.35, time=0.8))
    embers, ash = [[1.0, 0.75, 0.3], [0.85, 0.35, 0.15]], [[0.35, 0.33, 0.33], [0.75, 0.75, 0.77]]
    glow = OverLife("color", embers + ash, times=[0.0, 0.12, 0.3, 1.0])
    fade = OverLife("opacity", [0.5, 0.3, 0.0], times=[0.0, 0.3, 1.0])
    spread = OverLife("size", [0.06, 0.16, 0.5], times=[0.0, 0.3, 1.0])
    scene = Scene((buoyancy, LinearDrag(2.0, air=air)), (fire, Lifetime(), glow, fade, spread))
    camera = {"center": [0.0, 0.0, 2.3], "width": 6.8, "elevation": 8.0}
    return Setup(scene, empty_pool(4000, dim=3), 0.02, 250, 2, camera, {"background": "#15171c"})


def rain_on_pegs(rows: int = 9, spacing: float = 0.2) -> Setup:
    """Galton's board: drops fall through rows of pegs, which are one signed distance, and spread to a bell."""

    def pegs(t, point):
        row = jnp.round(point[1] / spacing)

        def to_peg(row):
            row = jnp.clip(row, 1, rows)
            x = jnp.mod(point[0] / spacing + row / 2, 1.0) - 0.5
            return jnp.hypot(x * spacing, point[1] - row * spacing) - 0.03

        return jnp.minimum(to_peg(row), jnp.minimum(to_peg(row - 1), to_peg(row + 1)))

    top = (rows + 2) * spacing
    cloud = Emitter(
        rate=400.0, position=FromLine([-0.03, top], [0.03, top]), velocity=Normal([0.0, -0.5], 0.1),
        color=Uniform([0.1, 0.3, 0.6], [0.3, 0.6, 0.95]), size=0.024, max_births=4,
    )  # fmt: skip
    contact = Collisions((pegs,), radius=0.012, restitution=0.35, friction=0.05)
    scene = Scene((Gravity([0.0, -9.81]), LinearDrag(1.5)), (cloud, DeathOutside([-2.0, -0.5], [2.0, 4.0]), contact))
    camera = {"center": [0.0, 1.1], "width": 3.2}
    return Setup(scene, empty_pool(1200, dim=2), 0.005, 1000, 8, camera)
