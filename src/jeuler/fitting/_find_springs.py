"""``find_springs``: which particles are joined, and by what springs, from tracks alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting._springs import SpringFit
from jeuler.fitting._tables import springs_text
from jeuler.fitting.finding.refined import refined, springs_of
from jeuler.fitting.finding.smoothing import at_samples, force_errors, motion_left
from jeuler.fitting.finding.tracked import Tracked
from jeuler.fitting.finding.whole_motion import by_whole_motion, in_doubt
from jeuler.fitting.finding.words import buried, hiding, not_explained, sentences, too_coarse
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState


@result
class FoundSprings:
    """What `find_springs` found.

    Attributes:
      edges: which particles are joined, (spring, 2).
      ks, kd, rest_length: of each spring, (spring,), N/m, N s/m and m.
      stderr: their standard errors by name, (spring,) each; inf where a rest length was taken to be 0 or a damping not
        seen. They hold the noise of the accelerations and what smoothing does to the forces.
      significance: how far above the noise each spring is, in standard errors, (spring,).
      candidates: the pairs that were looked at, (pair, 2).
      least_seen: the stiffness that a spring would need at each of them to be found in 95 of 100 records, (pair,), N/m.
      hidden: candidates that could hold a spring unseen, as the motion does not excite it, (pair, 2).
      explained: whether springs between the tracked particles, with the given forces, explain the motion down to the
        noise. If not, a particle or a force is missing, or the samples lie too far apart, and the springs are not to be
        trusted.
      sigma: the noise of the positions, m.
      scene, state: the scene with the springs and forces, and the state at the first time.
      fit: the `SpringFit` that refined the values; None where there was none.
      message: all of that in words.
    Example:
      >>> import numpy as np, jeuler
      >>> t = np.linspace(0.0, 6.0, 121)
      >>> swing = 0.5 + 0.1 * np.cos(np.sqrt(2 * 8.0) * t)  # two masses of 1 kg, ks = 8 N/m, rest length 1 m
      >>> found = jeuler.find_springs(t, np.stack([-swing, swing], axis=1)[:, :, None], mass=1.0, refine=False)
      >>> found.edges.tolist(), found.ks.round(3).tolist(), found.rest_length.round(3).tolist()
      ([[0, 1]], [8.0], [1.0])
    """

    _: dataclasses.KW_ONLY
    edges: np.ndarray
    ks: np.ndarray
    kd: np.ndarray
    rest_length: np.ndarray
    stderr: dict[str, np.ndarray]
    significance: np.ndarray
    candidates: np.ndarray
    least_seen: np.ndarray
    hidden: np.ndarray
    explained: bool
    sigma: float
    scene: Scene
    state: ParticleState
    fit: SpringFit | None
    message: str

    __repr__ = springs_text


@says_what_to_write(edges="candidates=", masses="mass=")
def find_springs(
    times: Any,
    positions: Any,
    *,
    mass: Any,
    candidates: Any = None,
    forces: Any = (),
    sigma: float | None = None,
    false_positives: float = 0.01,
    refine: bool = True,
) -> FoundSprings:
    """Find which particles are joined by springs, and ks, kd and rest length of each, from tracks alone.

        m_i x_i'' = sum_j (-ks d + ks L u - kd (dv . u) u) + forces,   d = x_i - x_j,   u = d / |d|

    is linear in ks, ks L and kd of every candidate pair. It is used in its weak form, multiplied by bumps and
    integrated by parts, so that no acceleration is taken from noisy positions, and weighted by the covariance that
    white noise of the positions has there. Pairs are added while they take more off the sum of squares than noise
    does, and each has to hold its place given all others; whether rest lengths and damping are there at all is Bayes'
    information criterion. A fit of the whole motion then refines the values.

    Args:
      times: when the positions were measured, (time,), s.
      positions: tracks, (time, particle, dim), m; NaN = not observed.
      mass: of the particles, a number or (particle,), kg; inf = pinned.
      candidates: pairs that may be joined, (pair, 2); None takes all, or of more than 2,500 the nearest.
      forces: what else acts, such as ``(jeuler.Gravity([0.0, -9.81]),)``, with known parameters.
      sigma: the noise of the positions, m; None estimates it from the tracks.
      false_positives: the chance, about, that noise alone puts one spring too many among those found. It is larger
        where the noise is no longer small: asked for 0.01, 50 nets with noise of 1 % of the motion had 4 in all.
      refine: whether the values are refined by `fit_springs`; not done for more than 500 numbers.
    Returns: `FoundSprings`; its ``message`` says which pairs the motion does not excite, and whether springs between
      these particles explain it at all.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import numpy as np, jeuler
      >>> t = np.linspace(0.0, 6.0, 121)
      >>> slow, fast = 0.3 * np.cos(2.0 * t), 0.2 * np.cos(np.sqrt(12.0) * t)  # two equal masses between walls
      >>> left, right = 1 + slow + fast, 2 + slow - fast  # ks = 4, 4, 4
      >>> tracks = np.stack([0 * t, left, right, 0 * t + 3], axis=1)[:, :, None]
      >>> found = jeuler.find_springs(t, tracks, mass=[np.inf, 1.0, 1.0, np.inf], refine=False)
      >>> found.edges.tolist(), found.ks.round(2).tolist()
      ([[0, 1], [1, 2], [2, 3]], [4.0, 4.0, 4.0])

    Source: D. A. Messenger, D. M. Bortz, Weak SINDy for partial differential equations, 2021, with the weighting of
      D. M. Bortz, D. A. Messenger, V. Dukic, Direct estimation of parameters in ODE models using WENDy, 2023; S. Chen,
      S. A. Billings, W. Luo, Orthogonal least squares methods, 1989.
    """
    checks.true_or_false("refine", refine)
    checks.positive("false_positives", false_positives)
    if not false_positives < 1:
        raise ValueError(f"false_positives must be a chance between 0 and 1, got {false_positives:g}")
    task = Tracked.of(times, positions, mass, candidates, forces, sigma)
    normal, found = task.searched(float(false_positives))
    again = by_whole_motion(task, normal, found, float(false_positives)) if in_doubt(task, found) else None
    found = found if again is None else again
    explained = not not_explained(normal, found)
    values = springs_of(task, found)
    hidden = hiding(task, found)
    words = list(sentences(task, normal, found, float(false_positives), hidden))
    if again is not None:
        words.append(
            "where the accelerations leave a choice, the whole motion made it: springs of half the usual stiffness or "
            "more in the most likely net"
        )
    fit = None
    if refine and len(found.chosen):
        values, fit, more = refined(task, found, values, explained)
        words += more
    if fit is None and len(found.chosen):
        values = values.with_errors(force_errors(task, found))
        words += buried(task, found)
    omega = motion_left(task, at_samples(task) if fit is None else np.asarray(fit.predicted))
    if omega is not None:
        explained = False
        words.insert(0, too_coarse(task, omega))
    return FoundSprings(
        edges=values.edges,
        ks=values.ks,
        kd=values.kd,
        rest_length=values.rest_length,
        stderr=values.stderr,
        significance=np.sqrt(found.statistic),
        candidates=task.pairs,
        least_seen=found.least_seen,
        hidden=hidden,
        explained=explained,
        sigma=task.motion.sigma,
        scene=values.scene(task) if fit is None else fit.scene,
        state=values.state(task) if fit is None else fit.state,
        fit=fit,
        message="; ".join(words),
    )
