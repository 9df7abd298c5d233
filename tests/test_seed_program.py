"""The seed program: particles with p, v, f, m; forces accumulated; velocity from acceleration; position from the OLD
velocity; correction for collisions; appearance. A plain transcription in NumPy gives the same trajectories."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jeuler import Gravity, LinearDrag, ParticleState, QuadraticDrag, Scene, Springs, simulate
from jeuler.particles.fields import uses

DT, STEPS, KS, KD, REST, DRAG, SWIRL, FLOOR = 1e-3, 2000, 40.0, 0.3, 0.4, 0.05, 0.02, -0.6
GRAVITY, WIND = np.array([0.0, -9.81]), np.array([1.5, 0.0])


@dataclasses.dataclass
class Particle:
    p: np.ndarray
    v: np.ndarray
    m: float
    f: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    c: float = 0.0


def seed_program(particles, edges):
    """The loop as one would write it first: one particle at a time, in the classical order."""
    frames = []
    for frame in range(STEPS):
        t = frame * DT
        for q in particles:
            q.f = np.zeros(2)
        for q in particles:  # accumulate forces
            q.f += q.m * GRAVITY
            q.f -= DRAG * (q.v - WIND)
            q.f -= SWIRL * np.linalg.norm(q.v) * q.v
            q.f += np.array([np.sin(3 * t), 0.0]) * q.m
        for i, j in edges:
            a, b = particles[i], particles[j]
            d = a.p - b.p
            r = np.linalg.norm(d)
            u = d / r
            f = KS * (REST - r) * u - KD * np.dot(a.v - b.v, u) * u
            a.f += f
            b.f -= f
        for q in particles:  # move
            if np.isinf(q.m):
                continue
            old_velocity = q.v
            q.v = q.v + DT * q.f / q.m
            q.p = q.p + DT * old_velocity
        for q in particles:  # correct for collisions
            if q.p[1] < FLOOR:
                q.p = np.array([q.p[0], FLOOR])
                q.v = np.array([q.v[0], -0.5 * q.v[1]])
        for q in particles:  # appearance: bright when fast
            q.c = min(1.0, np.linalg.norm(q.v) / 5.0)
        frames.append([(*q.p, *q.v, q.c) for q in particles])
    return np.array(frames)


def shake(t, position, velocity, mass):
    return mass[:, None] * jnp.stack([jnp.sin(3 * t), 0.0 * t])


def bounce(t, dt, state, key):
    below = state.position[:, 1] < FLOOR
    position = state.position.at[:, 1].set(jnp.where(below, FLOOR, state.position[:, 1]))
    velocity = state.velocity.at[:, 1].multiply(jnp.where(below, -0.5, 1.0))
    return state.replace(position=position, velocity=velocity)


@uses(sets=("opacity",))
def bright_when_fast(t, dt, state, key):
    return state.replace(opacity=jnp.minimum(1.0, jnp.linalg.norm(state.velocity, axis=1) / 5.0))


def test_the_seed_program_is_covered_as_it_stands(random):
    position = np.stack([0.3 * np.arange(5), np.zeros(5)], axis=1) + 0.02 * random.normal(size=(5, 2))
    velocity = random.normal(size=(5, 2))
    mass = random.uniform(0.05, 0.2, size=5)
    edges = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2)]
    expected = seed_program([Particle(p, v, m) for p, v, m in zip(position, velocity, mass, strict=True)], edges)

    scene = Scene(
        forces=(
            Gravity(GRAVITY),
            LinearDrag(DRAG, air=WIND),
            QuadraticDrag(SWIRL),
            Springs(edges, KS, KD, REST),
            shake,
        ),
        effects=(bounce, bright_when_fast),
    )
    frames = simulate(scene, ParticleState(position, velocity, mass), dt=DT, num_steps=STEPS).y
    found = np.concatenate([frames.position, frames.velocity, frames.opacity[..., None]], axis=-1)[1:]
    assert np.any(expected[:, :, 1] == FLOOR), "it met the floor"
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()
