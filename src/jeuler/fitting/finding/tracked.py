"""What was tracked: checked, and ready for the search of springs."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.fitting.finding.equations import SMOOTH, Motion, Normal, normal_equations
from jeuler.fitting.finding.selection import Selection, select
from jeuler.fitting.observations import checked_observations, noise_of
from jeuler.fitting.smooth import FEWEST

MOST_PAIRS = 2500  # candidates that are looked at where none are given: all pairs of 71 particles
LEAST_NOISE = 3e-6  # of the size of the motion: more than the integrals of exact data are in error by
PASSES = 2  # the second with the noise that the springs of the first make of that of the positions


@dataclasses.dataclass(frozen=True)
class Tracked:
    """Tracks with masses, candidates and the forces that are known.

    Attributes:
      left_out: particles that were not seen often enough.
      nearest: whether only the nearest pairs are candidates.
    """

    times: np.ndarray
    positions: np.ndarray
    mass: np.ndarray
    pairs: np.ndarray
    forces: tuple[Any, ...]
    motion: Motion
    left_out: tuple[int, ...]
    nearest: bool

    @classmethod
    def of(cls, times: Any, positions: Any, mass: Any, candidates: Any, forces: Any, sigma: Any) -> Tracked:
        """Checked, or one ValueError."""
        checks.untraced("find_springs", times, positions, mass)
        x = checks.reals("positions", positions, "numbers of shape (time, particle, dim), m")
        if x.ndim != 3 or x.shape[1] < 2 or not x.shape[2]:
            raise ValueError(
                f"positions must have shape (time, particle, dim) with two particles or more, got {x.shape}"
            )
        t = checks.reals("times", times, "numbers of shape (time,), s")
        first = float(np.min(t)) if t.size and np.isfinite(t).any() else 0.0
        t, x = checked_observations(t, x, x.shape[1:], first)
        m = _masses(mass, x.shape[1])
        x = _held_in_place(x, m)
        often = np.isfinite(x).all(axis=2).sum(axis=0) >= FEWEST
        moving = often & np.isfinite(m)
        if moving.any() and _size(x[:, moving]) == 0:
            raise ValueError("positions must show a motion, got particles at rest, in which no spring shows")
        if sigma is None:
            flat = x.reshape(len(t), -1)
            sigma = max(noise_of(t, flat, np.ones_like(flat)) or 0.0, LEAST_NOISE * _size(x))
        else:
            checks.positive("sigma", sigma, "m")
        motion = Motion.of(t, x, float(sigma))
        if motion is None or not moving.any():
            raise ValueError(f"times must be {FEWEST} or more at which a particle is seen, got {len(t)} in all")
        pairs, nearest = _candidates(candidates, x, m, often)
        return cls(t, x, m, pairs, _forces(forces), motion, tuple(np.flatnonzero(~often).tolist()), nearest)

    def searched(self, alpha: float) -> tuple[Normal, Selection]:
        """The springs that the weak form finds."""
        moving = np.isfinite(self.mass)
        half_width, force = self.motion.half_width(moving), self._known_force()
        stiffness = np.where(moving, (SMOOTH / half_width) ** 2, 0.0)  # as if each swung at the highest frequency
        begin: list[int] = []
        for turn in range(PASSES):
            normal = normal_equations(self.motion, self.pairs, self.mass, force, half_width, stiffness)
            if not normal.rows:
                raise ValueError(
                    f"times must show the particles together for longer, got {len(self.times)} times with gaps"
                )
            found = select(normal, alpha, begin, kinds=turn == PASSES - 1)
            stiffness, begin = np.zeros(len(self.mass)), found.chosen.tolist()
            np.add.at(stiffness, self.pairs[found.chosen].ravel(), np.repeat(found.values[:, 0], 2))
            stiffness = np.where(moving, stiffness / np.where(moving, self.mass, 1), 0)
        return normal, found

    def _known_force(self) -> np.ndarray:
        """Of the forces that are given, on the fine grid, (fine, particle, dim), N."""
        tracks = self.motion.tracks
        total = np.zeros_like(tracks.position)
        mass = jnp.asarray(self.mass)
        for force in self.forces:
            at = jax.jit(jax.vmap(lambda t, x, v, force=force: force(t, x, v, mass)))
            total += np.asarray(at(*(jnp.asarray(a) for a in (tracks.times, tracks.position, tracks.velocity))), float)
        return np.where(np.isfinite(self.mass)[:, None], total, 0)


def _size(x: np.ndarray) -> float:
    """Of the motion, m."""
    return float(np.nanmax(np.nanmax(x, axis=0) - np.nanmin(x, axis=0)))


def _masses(mass: Any, count: int) -> np.ndarray:
    m = checks.reals("mass", mass, "a number or one a particle, kg; inf = pinned")
    if m.shape not in ((), (count,)):
        raise ValueError(f"mass must be one number or have shape ({count},), one a particle, got {m.shape}")
    if not (m > 0).all():
        raise ValueError(f"mass must be above 0, inf for a pinned particle, got {m[~(m > 0)].ravel()[0]:g}")
    m = np.broadcast_to(m, (count,)).copy()
    if np.isinf(m).all():
        raise ValueError("mass must be finite for the particles that can move, got inf for all")
    return m


def _held_in_place(x: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Pinned particles at the mean of where they were seen, at all times."""
    x = np.array(x, float)
    for k in np.flatnonzero(np.isinf(mass)):
        seen = np.isfinite(x[:, k]).all(axis=1)
        if seen.any():
            x[:, k] = x[seen, k].mean(axis=0)
    return x


def _candidates(given: Any, x: np.ndarray, mass: np.ndarray, often: np.ndarray) -> tuple[np.ndarray, bool]:
    """Pairs of which one can move and both are seen, (pair, 2), and whether only the nearest are among them."""
    count = len(mass)
    if given is not None:
        pairs = np.asarray(checks.integers("candidates", given, "indices of particles, of shape (pair, 2)"), int)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs):
            raise ValueError(f"candidates must have shape (pair, 2) with at least one pair, got {pairs.shape}")
        checks.indices("candidates", pairs, count, "indices of particles")
        checks.different("candidates", pairs, "particles")
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    else:
        pairs = np.stack(np.triu_indices(count, 1), axis=1)
    useful = often[pairs].all(axis=1) & np.isfinite(mass[pairs]).any(axis=1)
    pairs = pairs[useful]
    if not len(pairs):
        raise ValueError("candidates must hold a pair of particles that are seen and of which one can move, got none")
    if given is not None or len(pairs) <= MOST_PAIRS:
        return pairs, False
    with np.errstate(all="ignore"):
        distance = np.array([np.nanmin(np.linalg.norm(x[:, a] - x[:, b], axis=1)) for a, b in pairs])
    return pairs[np.sort(np.argsort(distance)[:MOST_PAIRS])], True


def _forces(given: Any) -> tuple[Any, ...]:
    try:
        forces = tuple(given)
    except TypeError:
        raise ValueError(
            f"forces must be a tuple, such as (jeuler.Gravity([0.0, -9.81]),), got {checks.shown(given)}"
        ) from None
    for force in forces:
        if not callable(force):
            raise ValueError(f"forces must be forces such as jeuler.Gravity, got {checks.shown(force)}")
    return forces
