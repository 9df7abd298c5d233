"""How well `jeuler.find_springs` finds springs from tracks alone.

    python benchmarks/find_springs.py nets [COUNT, 50]    random nets of 10 to 60 particles at noise 0.1 % and 1 %
    python benchmarks/find_springs.py relational [RUNS, 500] [BALLS]    the setting of Neural Relational Inference
    python benchmarks/find_springs.py rope [--plot FILE]  a hanging rope with bending pairs, thrown
    python benchmarks/find_springs.py hidden              a soft body seen at every third particle

The tracks come from SciPy's method of eighth order at a tolerance of 1e-9, those of `relational` from the leapfrog
steps of that paper. Noise is a share of the root mean square displacement of all particles about their mean places.

Source: T. Kipf, E. Fetaya, K.-C. Wang, M. Welling, R. Zemel, Neural relational inference for interacting systems, 2018.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.sparse import coo_matrix
from scipy.spatial import Delaunay

import jeuler

NOISES = (0.001, 0.01)
KINDS = ("tree", "lattice", "delaunay", "random")


class Net(NamedTuple):
    """Springs between particles, and how these begin."""

    position: np.ndarray
    velocity: np.ndarray
    edges: np.ndarray
    ks: np.ndarray
    kd: np.ndarray
    rest_length: np.ndarray
    mass: np.ndarray


def tracks(net: Net, times: np.ndarray, gravity: float = 0.0) -> np.ndarray:
    """Positions at the times, (time, particle, dim)."""
    count, dim = net.position.shape
    i, j = net.edges.T
    springs = np.arange(len(i))
    ends = np.concatenate([i, j]), np.concatenate([springs, springs])
    to = coo_matrix((np.repeat([1.0, -1.0], len(i)), ends), shape=(count, len(i))).tocsr()
    weight = gravity * np.eye(dim)[-1]

    def slope(t, y):
        x, v = y.reshape(2, count, dim)
        d, dv = x[i] - x[j], v[i] - v[j]
        r = np.linalg.norm(d, axis=1)
        u = d / np.where(r > 0, r, 1)[:, None]
        force = to @ ((net.ks * (net.rest_length - r) - net.kd * np.sum(dv * u, axis=1))[:, None] * u)
        a = np.where(np.isinf(net.mass)[:, None], 0, force / net.mass[:, None] - weight)
        return np.concatenate([v.ravel(), a.ravel()])

    start = np.concatenate([net.position.ravel(), net.velocity.ravel()])
    y = solve_ivp(slope, times[[0, -1]], start, t_eval=times, rtol=1e-9, atol=1e-9, method="DOP853").y
    return y[: count * dim].T.reshape(-1, count, dim)


def random_net(seed: int) -> tuple[str, Net]:
    """In the plane or in space, a fifth of the springs 30 times softer than the others."""
    draw = np.random.default_rng(seed)
    dim, kind, count = 2 + seed % 2, KINDS[(seed // 2) % 4], int(draw.integers(10, 61))
    side = round(count ** (1 / dim))
    if kind == "lattice":
        grid = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), -1).reshape(-1, dim).astype(float)
        position = grid + 0.05 * draw.normal(size=grid.shape)
        edges = np.argwhere(np.triu(np.abs(grid[:, None] - grid[None]).sum(-1) == 1))
    else:
        points: list[np.ndarray] = []
        while len(points) < count:
            point = draw.uniform(0, 1.3 * count ** (1 / dim), dim)
            if all(np.linalg.norm(point - other) > 0.7 for other in points):
                points.append(point)
        position = np.array(points)
        edges = _edges(kind, position, draw)
    lengths = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1) * draw.uniform(0.9, 1.1, len(edges))
    ks = draw.uniform(20, 60, len(edges)) / np.where(draw.random(len(edges)) < 0.2, 30, 1)
    kd, mass = draw.uniform(0, 0.2, len(edges)), draw.uniform(0.5, 1.5, len(position))
    return kind, Net(position, 0.8 * draw.normal(size=position.shape), edges, ks, kd, lengths, mass)


def _edges(kind: str, position: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    count = len(position)
    if kind == "random":
        return np.array([(i, j) for i in range(count) for j in range(i + 1, count) if draw.random() < 4 / count])
    if kind == "tree":
        near = [np.argsort(np.linalg.norm(position[:k] - position[k], axis=1))[:3] for k in range(1, count)]
        return np.array([(int(draw.choice(some)), k) for k, some in enumerate(near, 1)])
    corners = Delaunay(position).simplices
    pairs = {tuple(sorted((c[a], c[b]))) for c in corners.tolist() for a in range(len(c)) for b in range(a)}
    edges = np.array(sorted(pairs))
    lengths = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1)
    return edges[lengths < 2.5 * np.median(lengths)]


def with_noise(positions: np.ndarray, share: float, seed: int) -> np.ndarray:
    size = np.sqrt(np.mean((positions - positions.mean(axis=0)) ** 2))
    return positions + share * size * np.random.default_rng(1000 + seed).normal(size=positions.shape)


def compared(found: jeuler.FoundSprings, edges: np.ndarray) -> tuple[set, set, set]:
    """What is right, false and missed."""
    truth, got = ({tuple(sorted(e)) for e in some.tolist()} for some in (edges, found.edges))
    return truth & got, got - truth, truth - got


def nets(count: int) -> None:
    """A missed spring counts as seen only where the answer does not say that so soft a one would be missed there."""
    sums = {noise: np.zeros(4, int) for noise in NOISES}
    seconds = []
    for seed in range(count):
        kind, net = random_net(seed)
        times = np.linspace(0, 12, 601)
        positions = tracks(net, times)
        for noise in NOISES:
            began = time.process_time()
            found = jeuler.find_springs(times, with_noise(positions, noise, seed), mass=net.mass, refine=False)
            seconds.append(time.process_time() - began)
            right, false, missed = compared(found, net.edges)
            needed = dict(zip(map(tuple, found.candidates.tolist()), found.least_seen.tolist(), strict=True))
            stiffness = {tuple(sorted(e)): k for e, k in zip(net.edges.tolist(), net.ks.tolist(), strict=True)}
            told = sum(stiffness[pair] < needed[pair] for pair in missed)
            sums[noise] += [len(right), len(false), len(missed) - told, told]
            print(
                f"{seed:3d} {kind:9s} {net.position.shape[1]}-D {len(net.position):2d} particles "
                f"{len(net.edges):3d} springs, noise {100 * noise:g} %: {len(right)} right, {len(false)} false, "
                f"{len(missed) - told} missed, {told} too soft to be seen and said so, {seconds[-1]:.1f} s of CPU, "
                f"{'explained' if found.explained else 'NOT EXPLAINED'}",
                flush=True,
            )
    for noise, (right, false, missed, told) in sums.items():
        print(
            f"noise {100 * noise:g} %: precision {right / (right + false):.4f}, recall {right / (right + missed):.4f} "
            f"where excited, {right / (right + missed + told):.4f} of all ({right} right, {false} false, "
            f"{missed} missed, {told} said to be too soft)"
        )
    print(f"seconds of CPU: median {np.median(seconds):.1f}, largest {max(seconds):.1f}")


def relational_run(draw: np.random.Generator, balls: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges, times and positions of one run: F = -0.1 (x_i - x_j), leapfrog at 0.001, 49 samples."""
    pairs = np.stack(np.triu_indices(balls, 1), axis=1)
    edges = pairs[draw.random(len(pairs)) < 0.5]
    velocity = draw.normal(size=(balls, 2))
    velocity *= 0.5 / np.linalg.norm(velocity, axis=1, keepdims=True)
    x = 0.5 * draw.normal(size=(balls, 2))
    pull = np.zeros((balls, balls))
    pull[edges[:, 0], edges[:, 1]] = pull[edges[:, 1], edges[:, 0]] = 0.1
    matrix = pull - np.diag(pull.sum(axis=1))
    dt, saved = 0.001, [x]
    velocity = velocity + dt / 2 * matrix @ x
    for n in range(1, 4801):
        x = x + dt * velocity
        velocity = velocity + dt * matrix @ x
        if n % 100 == 0:
            saved.append(x)
    return edges, 0.1 * np.arange(49), np.array(saved)


def relational(runs: int, sizes: tuple[int, ...]) -> None:
    """The share of pairs that are told right, as that paper counts them."""
    for balls in sizes:
        for noise in (0.0, 0.001, 0.01):
            wrong = false = 0
            largest, began = 0.0, time.process_time()
            for seed in range(runs):
                draw = np.random.default_rng(seed)
                edges, times, x = relational_run(draw, balls)
                x = x + noise * draw.normal(size=x.shape)
                found = jeuler.find_springs(times, x, mass=1.0, refine=False)
                right, more, less = compared(found, edges)
                wrong, false = wrong + len(more) + len(less), false + len(more)
                if right and not (more or less):
                    largest = max(largest, float(np.max(np.abs(found.ks - 0.1))) / 0.1)
            share = 1 - wrong / (runs * balls * (balls - 1) / 2)
            print(
                f"{balls:2d} balls, noise {noise:g}: {100 * share:.2f} % of the pairs right, {false / runs:.3f} false "
                f"springs a run, ks within {100 * largest:.2g} % where all are right, "
                f"{(time.process_time() - began) / runs:.2f} s of CPU a run",
                flush=True,
            )


def rope(plot: str | None) -> None:
    """Twelve particles on a chain with a bending spring over each second one, held at one end and thrown."""
    count = 12
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    bending = np.stack([np.arange(count - 2), np.arange(2, count)], axis=1)
    edges = np.concatenate([chain, bending])
    ks = np.repeat([400.0, 12.0], [count - 1, count - 2])
    lengths = np.repeat([0.1, 0.2], [count - 1, count - 2])
    mass = np.full(count, 0.05)
    mass[0] = np.inf
    position = np.stack([0.1 * np.arange(count), 0 * np.arange(count)], axis=1)
    velocity = np.random.default_rng(1).normal(size=(count, 2)) * 0.4
    velocity[0] = 0
    net = Net(position, velocity, edges, ks, np.full(len(edges), 0.05), lengths, mass)
    times = np.linspace(0, 3, 1501)
    positions = tracks(net, times, gravity=9.81)
    for noise in (0.0, *NOISES):
        began = time.process_time()
        found = jeuler.find_springs(
            times,
            with_noise(positions, noise, 0),
            mass=mass,
            forces=(jeuler.Gravity([0.0, -9.81]),),
            refine=False,
        )
        right, false, _ = compared(found, edges)
        of_chain = sum(b - a == 1 for a, b in right)
        print(
            f"rope, noise {100 * noise:g} %: {of_chain} of {len(chain)} chain springs, {len(right) - of_chain} of "
            f"{len(bending)} bending springs, {len(false)} false, {time.process_time() - began:.1f} s of CPU\n"
            f"  {found.message}"
        )
        if plot is not None and noise == NOISES[0]:
            from jeuler.plotting import plot_net

            plot_net(positions[400], found.edges, found.ks, pinned=np.isinf(mass)).savefig(plot, dpi=110)


def hidden() -> None:
    """A soft body of 6 by 6 particles with diagonals: all of them seen, and every third."""
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(6), indexing="ij"), -1).reshape(-1, 2).astype(float)
    apart = np.abs(grid[:, None] - grid[None])
    edges = np.argwhere(np.triu(apart.max(-1) == 1))
    lengths = np.linalg.norm(grid[edges[:, 0]] - grid[edges[:, 1]], axis=1)
    speed = 0.3 * np.random.default_rng(0).normal(size=grid.shape)
    net = Net(grid, speed, edges, np.full(len(edges), 30.0), np.full(len(edges), 0.1), lengths, np.ones(36))
    times = np.linspace(0, 6, 401)
    positions = tracks(net, times)
    for noise in (0.0, *NOISES):
        seen = with_noise(positions, noise, 0)
        whole = jeuler.find_springs(times, seen, mass=1.0, refine=False)
        right, false, _ = compared(whole, edges)
        print(f"all seen, noise {100 * noise:g} %: {len(right)} of {len(edges)}, {len(false)} false; {whole.message}")
        third = jeuler.find_springs(times, seen[:, ::3], mass=1.0, refine=False)
        print(f"every third, noise {100 * noise:g} %: explained {third.explained}; {third.message}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["nets", "relational", "rope", "hidden"])
    parser.add_argument("count", nargs="?", type=int)
    parser.add_argument("balls", nargs="?", type=int)
    parser.add_argument("--plot", help="where the picture of the rope goes")
    given = parser.parse_args()
    if given.part == "nets":
        nets(given.count or 50)
    elif given.part == "relational":
        relational(given.count or 500, (given.balls,) if given.balls else (5, 10))
    elif given.part == "rope":
        rope(given.plot)
    else:
        hidden()


if __name__ == "__main__":
    main()
