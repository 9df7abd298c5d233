"""The systems that every peer runs: arrays and numbers, no library's types. Units are SI, arrays float32."""

from __future__ import annotations

import dataclasses

import numpy as np

KS, KD, DT = 100.0, 0.1, 1e-3


@dataclasses.dataclass(frozen=True)
class Work:
    """Springs between particles, or free particles (no edges), in ``batch`` equal systems side by side."""

    name: str
    position: np.ndarray  # (batch, particle, 3)
    velocity: np.ndarray  # (batch, particle, 3)
    edges: np.ndarray  # (spring, 2)
    rest_length: np.ndarray  # (spring,)
    steps: int
    gravity: float = 0.0  # m/s^2, downwards along the last axis
    drag: float = 0.0  # quadratic, kg/m

    @property
    def batch(self) -> int:
        return len(self.position)

    @property
    def units(self) -> int:
        """What the time is divided by, beside the steps: springs, or particles where there are none."""
        return self.batch * (len(self.edges) or self.position.shape[1])

    def flat(self) -> Work:
        """The whole batch as one system."""
        count = self.position.shape[1]
        first = count * np.arange(self.batch)[:, None, None]
        return dataclasses.replace(
            self,
            position=self.position.reshape(1, -1, 3),
            velocity=self.velocity.reshape(1, -1, 3),
            edges=(self.edges + first).reshape(-1, 2).astype(np.int32),
            rest_length=np.tile(self.rest_length, self.batch),
        )


def _work(name: str, position: np.ndarray, edges: np.ndarray, steps: int, **more) -> Work:
    rng = np.random.default_rng(7)
    rest = np.linalg.norm(np.diff(position[edges], axis=1)[:, 0], axis=1) if len(edges) else np.zeros(0)
    position = position + 0.01 * rng.normal(size=position.shape)
    velocity = 0.1 * rng.normal(size=position.shape)
    arrays = position[None].astype(np.float32), velocity[None].astype(np.float32)
    return Work(name, *arrays, edges.astype(np.int32), rest.astype(np.float32), steps, **more)


def cloth(side: int, steps: int) -> Work:
    """A square of cloth: structural, shear and bend springs."""
    at = np.arange(side * side).reshape(side, side)
    pairs = [
        (at[:, :-1], at[:, 1:]),
        (at[:-1], at[1:]),
        (at[:-1, :-1], at[1:, 1:]),
        (at[:-1, 1:], at[1:, :-1]),
        (at[:, :-2], at[:, 2:]),
        (at[:-2], at[2:]),
    ]
    edges = np.concatenate([np.stack([i.ravel(), j.ravel()], axis=1) for i, j in pairs])
    grid = np.stack([*np.divmod(at.ravel(), side), 0 * at.ravel()], axis=1).astype(float)
    return _work(f"cloth {side}x{side}, {len(edges):,} springs", grid, edges, steps)


def mesh(springs: int, steps: int) -> Work:
    """The edges of a Delaunay tetrahedralisation of random points, particles and springs in random order."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(11)
    count = max(20, round(springs / 7.65))
    points = rng.random((count, 3)) * count ** (1 / 3)
    corners = Delaunay(points).simplices
    edges = np.concatenate([corners[:, [a, b]] for a in range(4) for b in range(a)])
    edges = rng.permutation(np.unique(np.sort(edges, axis=1), axis=0))
    return _work(f"shuffled mesh, {len(edges):,} springs", points, edges, steps)


def chains(batch: int, count: int, steps: int) -> Work:
    """Many short chains."""
    line = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(float)
    edges = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    one = _work(f"{batch:,} chains of {count}", line, edges, steps)
    noise = 0.01 * np.random.default_rng(13).normal(size=(batch, count, 3))
    position = (one.position + noise).astype(np.float32)
    return dataclasses.replace(one, position=position, velocity=np.repeat(one.velocity, batch, axis=0))


def free(count: int, steps: int) -> Work:
    """Particles that fall through air."""
    points = np.random.default_rng(17).random((count, 3))
    return _work(f"{count:,} free particles", points, np.zeros((0, 2)), steps, gravity=9.81, drag=0.1)


def works(small: bool) -> list[Work]:
    """All of them; ``small`` leaves out what takes minutes."""
    chosen = [
        cloth(16, 400),
        cloth(64, 100),
        mesh(1000, 400),
        mesh(100_000, 20),
        chains(1024, 16, 100),
        free(100_000, 30),
    ]
    if not small:
        chosen += [cloth(256, 20), cloth(512, 20), mesh(10_000, 100), mesh(1_000_000, 6)]
    return chosen
