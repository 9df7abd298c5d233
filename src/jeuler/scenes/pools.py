"""Scenes of particles that are born and die: water, smoke, rain."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jeuler.contact import Collisions, Plane
from jeuler.effects import Emitter, Lifetime, OverLife, SubEmitter, Trail
from jeuler.forces import Gravity, Gust, LinearDrag, Vortex, turbulence
from jeuler.particles import Scene, empty_pool, uses
from jeuler.samplers import Choice, Cone, FromDisc, FromLine, FromSphere, Normal, Uniform
from jeuler.scenes.setup import Setup


def fountain() -> Setup:
    """A fountain: a jet of drops that a gusting wind carries off and the ground throws back."""
    jet = Emitter(
        rate=2500.0,
        position=FromDisc([0.0, 0.0, 0.1], radius=0.06),
        velocity=Cone([0.0, 0.0, 1.0], speed=Uniform(7.0, 7.8), angle=0.12),
        lifetime=Uniform(2.2, 2.8),
        max_births=60,
    )
    air = (Gust([6.0, 0.0, 0.0], period=8.0), turbulence(dim=3, speed=0.8, size=0.5, time=1.0))
    ground = Collisions((Plane([0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]),), restitution=0.3, friction=0.2)
    blue = OverLife("color", [[0.95, 0.98, 1.0], [0.45, 0.7, 0.95], [0.2, 0.4, 0.8]])
    fade = OverLife("opacity", [0.95, 0.7, 0.0], times=[0.0, 0.8, 1.0])
    grow = OverLife("size", [0.035, 0.06])
    scene = Scene((Gravity([0.0, 0.0, -9.81]), LinearDrag(0.35, air=air)), (jet, Lifetime(), ground, blue, fade, grow))
    camera = {"center": [0.9, 0.0, 1.2], "width": 5.8, "azimuth": -90.0, "elevation": 7.0}
    look = {"background": "#5c7796", "sky": "#0d1526", "solids": "#27313d", "particles": "streaks", "width": 1.6}
    return Setup(scene, empty_pool(7500, dim=3), 0.02, 200, 2, camera, look)


def smoke_column() -> Setup:
    """Smoke that rises while it is hot, turns about a vortex, spreads and fades."""

    @uses(reads=("age",))
    def buoyancy(t, position, velocity, mass, age):
        return (6.0 * jnp.exp(-age / 1.2))[:, None] * jnp.array([0.0, 0.0, 1.0], position.dtype)

    fire = Emitter(
        rate=1500.0, position=FromDisc([0.0, 0.0, 0.0], radius=0.22), velocity=Normal([0.0, 0.0, 0.5], 0.15),
        lifetime=Uniform(2.5, 4.0), max_births=40,
    )  # fmt: skip
    air = (Vortex([0.0, 0.0, 0.0], circulation=5.0, core=0.5), turbulence(dim=3, speed=0.45, size=0.35, time=0.8))
    embers, ash = [[1.0, 0.75, 0.3], [0.85, 0.35, 0.15]], [[0.35, 0.33, 0.33], [0.75, 0.75, 0.77]]
    glow = OverLife("color", embers + ash, times=[0.0, 0.12, 0.3, 1.0])
    fade = OverLife("opacity", [0.5, 0.22, 0.0], times=[0.0, 0.3, 1.0])
    spread = OverLife("size", [0.06, 0.16, 0.5], times=[0.0, 0.3, 1.0])
    scene = Scene((buoyancy, LinearDrag(2.0, air=air)), (fire, Lifetime(), glow, fade, spread))
    camera = {"center": [0.0, 0.0, 2.35], "width": 9.0, "elevation": 8.0}
    look = {"background": "#39424d", "sky": "#0e1116", "particles": "puffs", "thickness": 0.5}
    return Setup(scene, empty_pool(6000, dim=3), 0.02, 250, 2, camera, look)


def fireworks() -> Setup:
    """Rockets that burst into stars of their colour where they burn out; each draws its trail."""
    colors = [[1.0, 0.45, 0.3], [1.0, 0.8, 0.35], [0.5, 0.8, 1.0], [0.7, 1.0, 0.6], [1.0, 0.6, 0.95]]
    rockets = Emitter(
        rate=3.0, position=FromDisc([0.0, 0.0, 0.0], radius=7.0), velocity=Cone([0.0, 0.0, 1.0], 34.0, angle=0.15),
        lifetime=Uniform(1.5, 2.0), color=Choice(colors), size=0.12, max_births=1,
    )  # fmt: skip
    stars = FromSphere([0.0, 0.0, 0.0], radius=14.0, surface=True)
    burst = SubEmitter(
        150, velocity=stars, inherit=0.4, lifetime=Normal(1.5, 0.2), size=0.1, inherits=("color",), max_births=360
    )
    fade = OverLife("opacity", [1.0, 1.0, 0.0], times=[0.0, 0.6, 1.0])
    scene = Scene((Gravity([0.0, 0.0, -9.81]), LinearDrag(0.9)), (Lifetime(), burst, rockets, fade, Trail(12)))
    camera = {"center": [0.0, 0.0, 14.0], "width": 44.0, "azimuth": -90.0, "elevation": 4.0}
    look = {"background": "#1a2038", "sky": "#04060d", "haze": 0.0}
    return Setup(scene, empty_pool(1500, dim=3), 0.04, 150, 2, camera, look)


def rain_on_pegs(rows: int = 12, spacing: float = 0.2, drops: int = 2000) -> Setup:
    """Galton's board: drops fall through rows of pegs into bins, one signed distance, and heap up to a bell."""

    def board(t, point):
        row = jnp.round(point[1] / spacing)
        to_wall = jnp.maximum(jnp.abs(point[0] - spacing * jnp.round(point[0] / spacing)) - 0.006, point[1] - 0.1)

        def to_peg(row):
            row = jnp.clip(row, 1, rows)
            x = jnp.mod(point[0] / spacing + row / 2, 1.0) - 0.5
            return jnp.hypot(x * spacing, point[1] - row * spacing) - 0.03

        pegs = jnp.minimum(to_peg(row), jnp.minimum(to_peg(row - 1), to_peg(row + 1)))
        return jnp.minimum(to_wall, pegs)

    top = (rows + 1) * spacing
    cloud = Emitter(
        rate=drops / 5, position=FromLine([-0.03, top], [0.03, top]), velocity=Normal([0.0, -0.5], 0.1),
        color=Uniform([0.1, 0.3, 0.6], [0.3, 0.6, 0.95]), size=0.024, stop=5.0, max_births=4,
    )  # fmt: skip
    contact = Collisions((board,), radius=0.012, restitution=0.35, friction=0.05)
    scene = Scene((Gravity([0.0, -9.81]), LinearDrag(1.5)), (cloud, contact, heap(spacing, floor=-1.5)))
    camera = {"center": [0.0, 0.6], "width": 6.2}
    return Setup(scene, empty_pool(drops, dim=2), 0.005, 1500, 12, camera, {"background": "#f6f3ec"})


RESTING = 5  # the shape of a drop at rest, drawn as that of the others


def heap(spacing: float, floor: float, drop: float = 0.025) -> Any:
    """An effect: what falls into a bin comes to rest there, upon all that did before it."""
    bins, abreast = 40, int((spacing - 0.02) / drop)

    @uses(writes=("shape",))
    def effect(t, dt, previous, state, key):
        rests = (state.shape == RESTING) & state.alive
        here = jnp.clip(jnp.floor(state.position[:, 0] / spacing).astype(int) + bins // 2, 0, bins - 1)
        per_bin = jnp.zeros(bins, int).at[here].add(rests)
        ground = floor + drop * (per_bin[here] // abreast + 0.5)
        arrives = state.alive & ~rests & (state.position[:, 1] < ground)
        in_bin = jax.nn.one_hot(here, bins, dtype=int) * arrives[:, None]
        rank = per_bin[here] + jnp.take_along_axis(jnp.cumsum(in_bin, axis=0), here[:, None], axis=1)[:, 0] - 1
        x = (here - bins // 2) * spacing + spacing / 2 + drop * (rank % abreast - (abreast - 1) / 2)
        place = jnp.stack([x, floor + drop * (rank // abreast + 0.5)], axis=1).astype(state.position.dtype)
        position = jnp.where(arrives[:, None], place, state.position)
        position = jnp.where(rests[:, None], previous.position, position)
        still = (rests | arrives)[:, None]
        shape = jnp.where(arrives, RESTING, state.shape).astype(state.shape.dtype)
        return state.replace(position=position, velocity=jnp.where(still, 0, state.velocity), shape=shape)

    return effect
