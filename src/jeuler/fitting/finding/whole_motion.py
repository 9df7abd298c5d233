"""Springs without rest length and damping between free particles: their whole motion, in closed form.

    M x'' = -K x,   x(t) = sum over the modes of K,   K = sum_k ks_k b_k b_k^T

So the likelihood of all stiffnesses at once costs an eigenvalue problem, and noisy tracks say more by it than by their
accelerations. That no stiffness is negative decides where the data alone would not.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jeuler.fitting.finding.equations import Normal
from jeuler.fitting.finding.selection import Selection, selected
from jeuler.fitting.finding.tracked import Tracked

MOST_PAIRS = 66  # all pairs of 12 particles
DOUBT = 0.5  # of the usual stiffness: where that much could be hidden, the whole motion is asked
ITERATIONS = 15
FOLLOWS = 2.0  # times the noise
ROUNDING = 1e-13  # added to a diagonal of ones, for columns that are the same


def in_doubt(task: Tracked, found: Selection) -> bool:
    """Whether the equations of motion leave a choice that the whole motion can make."""
    fits = found.terms == (True, False, False) and not task.forces and 0 < len(task.pairs) <= MOST_PAIRS
    if not fits or not len(found.chosen) or not (np.isfinite(task.mass).all() and np.isfinite(task.positions).all()):
        return False
    rest = np.setdiff1d(np.arange(len(task.pairs)), found.chosen)
    return bool(np.any(found.least_seen[rest] > DOUBT * np.median(found.values[:, 0])))


def by_whole_motion(task: Tracked, normal: Normal, found: Selection, alpha: float) -> Selection | None:
    """The springs of half the usual stiffness or more in the most likely net, or that stand out of the noise anyway.

    None where the motion is not followed down to the noise.
    """
    motion = Closed.of(task)
    usual = float(np.median(found.values[:, 0]))
    ks, left = motion.most_likely(np.full(len(task.pairs), 0.5 * usual), usual)
    if left > FOLLOWS**2 * task.positions.size * task.motion.sigma**2 or not (ks > 0).any():
        return None
    usual = float(np.median(ks[ks > DOUBT * usual])) if (ks > DOUBT * usual).any() else usual
    sure = np.isin(np.arange(len(ks)), found.chosen[found.statistic > 0]) & (ks > 0) & (ks <= DOUBT * usual)
    sure &= motion.deviations(ks, usual) * task.motion.sigma * 4 < ks
    chosen = np.flatnonzero((ks > DOUBT * usual) | sure)
    return selected(normal, found.terms, chosen.tolist(), alpha)


@dataclasses.dataclass(frozen=True)
class Closed:
    """Tracks of free particles on springs of length 0.

    Attributes:
      times: from the first, (time,), s.  y: (time particle, dim), m.  ends: b of each pair over root mass.
    """

    times: np.ndarray
    y: np.ndarray
    ends: np.ndarray
    root_mass: np.ndarray

    @classmethod
    def of(cls, task: Tracked) -> Closed:
        count, root_mass = len(task.pairs), np.sqrt(task.mass)
        ends = np.zeros((count, len(task.mass)))
        ends[np.arange(count), task.pairs[:, 0]], ends[np.arange(count), task.pairs[:, 1]] = 1, -1
        y = task.positions.reshape(-1, task.positions.shape[2])
        return cls(task.times - task.times[0], y, ends / root_mass, root_mass)

    def residual(self, ks: np.ndarray) -> np.ndarray:
        """What is left of the tracks with the best initial positions and velocities.

        The products of two columns of the basis are those of their shapes times those of their functions of time, so
        that the normal equations are small: the basis, as long as the tracks, is never made.
        """
        squares, modes = np.linalg.eigh(self.ends.T @ (ks[:, None] * self.ends))
        omega = np.sqrt(np.maximum(squares, 0))[:, None]
        sine = np.where(omega > 1e-9, np.sin(omega * self.times) / np.maximum(omega, 1e-9), self.times)
        swing = np.concatenate([np.cos(omega * self.times), sine])  # (2 mode, time)
        shapes = np.tile(modes / self.root_mass[:, None], 2)  # (particle, 2 mode)
        gram = (shapes.T @ shapes) * (swing @ swing.T)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        gram = gram / np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
        y = self.y.reshape(len(self.times), len(self.root_mass), -1)
        along = np.einsum("kt,tkd->kd", swing, np.einsum("ak,tad->tkd", shapes, y)) / scale[:, None]
        amplitude = np.linalg.solve(gram, along) / scale[:, None]
        return (y - np.einsum("ak,tkd->tad", shapes, swing.T[:, :, None] * amplitude)).ravel()

    def jacobian(self, ks: np.ndarray, r: np.ndarray, usual: float) -> np.ndarray:
        """By forward differences."""
        step = 1e-4 * usual
        return np.stack([self.residual(ks + step * one) - r for one in np.eye(len(ks))], axis=1) / step

    def most_likely(self, ks: np.ndarray, usual: float) -> tuple[np.ndarray, float]:
        """Non-negative stiffnesses with the least sum of squares, and that: Levenberg-Marquardt steps."""
        from scipy.optimize import nnls

        r, damping = self.residual(ks), 1e-4
        jacobian = self.jacobian(ks, r, usual)
        for _ in range(ITERATIONS):
            scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
            across = jacobian / scale
            gram = across.T @ across + damping * np.eye(len(ks))
            root = np.linalg.cholesky(gram)  # |root^T z - shift|^2 is the sum of squares of the damped, linear problem
            shift = np.linalg.solve(root, gram @ (scale * ks) - across.T @ r)
            trial = nnls(root.T, shift, maxiter=50 * len(ks))[0] / scale
            new = self.residual(trial)
            gain = float(r @ r - new @ new)
            if gain <= 0:
                damping *= 10
                if damping > 1e3:
                    break
                continue
            ks, r, damping = trial, new, max(damping / 10, 1e-9)
            if gain < 1e-6 * float(r @ r):
                break
            jacobian = self.jacobian(ks, r, usual)
        return ks, float(r @ r)

    def deviations(self, ks: np.ndarray, usual: float) -> np.ndarray:
        """Standard deviations of those above 0 for noise of 1 m, given that the others are 0."""
        jacobian = self.jacobian(ks, self.residual(ks), usual)
        free = ks > 0
        found = np.full(len(ks), np.inf)
        found[free] = np.sqrt(np.maximum(np.diag(np.linalg.pinv(jacobian[:, free].T @ jacobian[:, free])), 0))
        return found
