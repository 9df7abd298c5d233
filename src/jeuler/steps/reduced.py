"""Large systems: the equation in a small space that holds its fastest modes, and runs of the step that check it."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jeuler._core import trees
from jeuler.steps.explicit import Step

MOST = 64  # dimension of the Krylov space
MOST_WHOLE = 192  # the same for a state without halves, of at most MANY numbers
MANY = 20_000  # numbers in the state
LEAST, LONGER = 6, 1.5  # runs on a slow machine, in so many times the seconds at most
SEGMENTS = 4  # of a run, compared with each other


def arnoldi(product: Callable[[np.ndarray], np.ndarray], start: np.ndarray, most: int) -> np.ndarray:
    """Orthonormal columns that span start, A start, A^2 start, ...

    Source: W. E. Arnoldi, The principle of minimized iterations, Q. Appl. Math. 9, 1951.
    """
    most = min(most, start.size)
    basis = np.zeros((start.size, most), order="F")
    vector, size = start, np.linalg.norm(start)
    for k in range(most):
        basis[:, k] = vector / size
        vector = product(basis[:, k])
        before = np.linalg.norm(vector)
        for _ in range(2):  # twice: once would leave roundoff that is not orthogonal
            vector = vector - basis[:, : k + 1] @ (basis[:, : k + 1].T @ vector)
        size = np.linalg.norm(vector)
        if size <= 1e-12 * before:  # the space is closed
            return basis[:, : k + 1]
    return basis


@dataclasses.dataclass
class Reduced:
    """y' = J y in a small space, z' = matrix z with y = lift(z); the state keeps its outermost parts.

    Attributes:
      matrix: J in that space.
      like: a state of the form on which a step is to work there.
      lift: from there to the numbers of the state.
    """

    matrix: np.ndarray
    like: Any
    lift: Callable[[np.ndarray], np.ndarray]


def reduced_pair(product: Callable[..., Any], n: int, weights: np.ndarray) -> Reduced:
    """A pair (position, velocity) of equal halves, both in the space of the fastest of K + s C.

    x' = v, v' = -K x - C v;  in the coordinates sqrt(m) x K and C of springs are symmetric, and so they stay.
    weights: the square roots of the masses, or ones, (n / 2,); 0 for what is pinned, which stays out.
    """
    half = n // 2
    inverse = np.divide(1.0, weights, out=np.zeros(half), where=weights > 0)

    def slope(x, v):
        image = product(np.concatenate([x * inverse, v * inverse]))
        return image[:half] * weights, image[half:] * weights

    still = np.zeros(half)
    start = np.random.default_rng(0).standard_normal(half) * (weights > 0)
    direction, rate = start / np.linalg.norm(start), 1.0
    for _ in range(8):
        direction = slope(direction, still)[1]
        size = np.linalg.norm(direction)
        if not size > 0:
            break
        rate = np.sqrt(size)
        direction = direction / size
    both = []  # slopes of (u, rate u)

    def image(u):
        both.append(slope(u, rate * u))
        return both[-1][1]

    basis = arnoldi(image, start, MOST)
    of_position = [slope(column, still) for column in basis.T]
    of_velocity = [
        tuple((a - b) / rate for a, b in zip(*pair, strict=True)) for pair in zip(both, of_position, strict=True)
    ]
    columns = [np.concatenate([basis.T @ dx, basis.T @ dv]) for dx, dv in (*of_position, *of_velocity)]
    k = basis.shape[1]
    like = jnp.zeros(k), jnp.zeros(k)
    lift = lambda z: np.concatenate([basis @ z[:k] * inverse, basis @ z[k:] * inverse])  # noqa: E731
    return Reduced(np.stack(columns, axis=1), like, lift)


def reduced_whole(product: Callable[..., Any], n: int) -> Reduced:
    """A state without halves, in the Krylov space of J."""
    basis = arnoldi(product, np.random.default_rng(0).standard_normal(n), MOST_WHOLE if n <= MANY else MOST)
    matrix = np.stack([basis.T @ product(column) for column in basis.T], axis=1)
    return Reduced(matrix, jnp.zeros(basis.shape[1]), lambda z: basis @ z)


def symmetric_weights(product: Callable[..., Any], n: int, masses: Any) -> np.ndarray:
    """Square roots of the masses, one a number of the position, where they make K symmetric; ones where not.

    0 for what is pinned: it moves others where it is moved, but nothing moves it.
    """
    half = n // 2
    mass = np.asarray(masses, dtype=float).ravel() if masses is not None else np.ones(0)
    if not mass.size or half % mass.size or not np.all(mass > 0):
        return np.ones(half)
    mass = np.repeat(mass, half // mass.size)
    free = np.isfinite(mass)
    weights = np.sqrt(np.where(free, mass, 1.0))
    random = np.random.default_rng(1)
    a, b = random.standard_normal((2, half)) * free

    def image(u):
        return weights * product(np.concatenate([u / weights, np.zeros(half)]))[half:]

    ab, ba = float(a @ image(b)), float(b @ image(a))
    return free * (weights if abs(ab - ba) <= 1e-6 * max(abs(ab), abs(ba)) else 1.0)


class Runs:
    """Runs of the step on the linearised equation in full size: whether a perturbation grows at a dt."""

    run: Callable[..., Any]
    seconds: float
    begun: float
    length: int
    count: int

    def __init__(self, field: Callable[..., Any], step: Step, like: Any, seconds: float) -> None:
        unflatten = trees.real_vector(like)[1]

        @jax.jit
        def run(t, flat, u, dt, count):
            push = jax.linearize(functools.partial(field, t), flat)[1]

            def linear(t, y, args):
                return unflatten(push(trees.real_vector(y)[0]))

            def one_step(_, carry):
                u, height, peak = carry
                u = trees.real_vector(step(linear, jnp.zeros_like(dt), unflatten(u), dt, None))[0]
                size = jnp.linalg.norm(u)
                height = height + jnp.log(size)
                return u / size, height, jnp.maximum(peak, height)

            def segment(carry, _):
                u, height, peak = lax.fori_loop(0, count, one_step, (*carry, -jnp.inf))
                return (u, height), peak

            return lax.scan(segment, (u / jnp.linalg.norm(u), 0.0), None, length=SEGMENTS)[1]

        self.run, self.seconds, self.begun = run, seconds, math.inf
        self.length = self.count = 0

    @property
    def late(self) -> bool:
        return time.perf_counter() - self.begun > self.seconds * (1 if self.count >= LEAST else LONGER)

    def grows(self, t: Any, flat: Any, u: np.ndarray, dt: float) -> bool:
        """Whether a perturbation u grows without bound: by the same factor, again and again."""
        run = functools.partial(self.run, t, flat, jnp.asarray(u), jnp.asarray(dt, jnp.float64))
        if not self.length:
            jax.block_until_ready(run(1))  # compiles
            self.begun = time.perf_counter()
            jax.block_until_ready(run(5))
            each = (time.perf_counter() - self.begun) / 5 / SEGMENTS
            self.length = int(np.clip(self.seconds / 8 / each / SEGMENTS, 50, 500))
        peaks = np.asarray(run(self.length))
        self.count += 1
        rise = np.diff(peaks)
        # a drift, or slow modes that begin to swing, grow as a power of time: by less, from segment to segment
        return not np.all(np.isfinite(peaks)) or bool(rise[-1] > 0.7 and rise[-1] >= 0.85 * rise[-2])
