"""Scenes that several tests of hard cases share."""

import functools

import jax.numpy as jnp
import numpy as np

import jeuler


@functools.cache
def cloth_springs(n):
    """Edges and lengths of a square cloth of n x n particles and 1 m: structural, shear and bending springs."""
    index = np.arange(n * n).reshape(n, n)
    edges, lengths = [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)):
        rows, columns = np.arange(n - di), np.arange(max(0, -dj), n - max(0, dj))
        first = index[np.ix_(rows, columns)].ravel()
        edges.append(np.stack([first, first + di * n + dj], axis=1))
        lengths.append(np.full(len(first), np.hypot(di, dj) / (n - 1)))
    return np.concatenate(edges), np.concatenate(lengths)


def cloth(n, dtype=jnp.float64, speed=0.1):
    """A cloth of 0.2 kg held at two corners, flat at rest length, its velocity a waving field of this speed, m/s."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij"), axis=-1).reshape(-1, 2)
    position = np.column_stack([grid, np.zeros(n * n)])
    x, y = grid.T
    velocity = speed * np.column_stack([np.sin(7 * y), np.cos(5 * x), np.sin(9 * x + 4 * y)])
    mass = np.full(n * n, 0.2 / n**2)
    mass[[0, n - 1]] = np.inf
    return jeuler.ParticleState(*(jnp.asarray(x, dtype) for x in (position, velocity, mass)))


def cloth_scene(n, ks, kd):
    edges, lengths = cloth_springs(n)
    springs = jeuler.Springs(edges, ks=ks, kd=kd, rest_length=lengths)
    return jeuler.Scene(forces=(jeuler.Gravity([0.0, 0.0, -9.81]), springs))
