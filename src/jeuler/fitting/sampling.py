"""Whether a recording samples the motion that was fitted to it often enough to tell it from a faster or slower one."""

from __future__ import annotations

import numpy as np

from jeuler.fitting.oscillation import modes
from jeuler.forces.springs import Springs
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

MOST_MODES = 24  # of which the frequencies are computed


def aliased(given: Scene, fitted: Scene, state: ParticleState, times: np.ndarray) -> list[str]:
    """A sentence if the slowest mode of the fitted scene has less than five samples a period, or that of the given two.

    Equally spaced samples do not tell an angular frequency from 2 pi / spacing minus it (Nyquist): a motion of few
    samples a period may be a faster one, seen wrongly.
    """
    gaps = np.diff(np.unique(times))
    if not len(gaps) or gaps.max() > 1.5 * gaps.min():  # unequal spacing tells aliases apart
        return []
    spacing = float(np.median(gaps))
    slowest = _slowest(fitted, state, 2 * np.pi / 5 / spacing)
    if slowest is not None:
        samples = 2 * np.pi / slowest / spacing
        return [
            f"the fitted motion has only {samples:.2g} samples a period: a motion of another stiffness, faster or "
            f"slower, would fit as well (aliasing); measure more often, or at unequal times"
        ]
    if _slowest(given, state, np.pi / spacing) is not None:
        return [
            "at the given stiffness the motion would have less than two samples a period, which cannot be told from a "
            "slower one: the slower was fitted (aliasing); measure more often, or at unequal times"
        ]
    return []


def _slowest(scene: Scene, state: ParticleState, limit: float) -> float | None:
    """The angular frequency of the slowest mode if that is above a limit, rad/s; None where there are many modes."""
    mass = np.broadcast_to(np.asarray(state.mass, float), state.position.shape[:1])
    moving = int(np.isfinite(mass).sum()) * state.position.shape[1]
    if not 0 < moving <= MOST_MODES or fastest(scene, mass) < limit:
        return None
    found = [mode.angular_frequency for mode in modes(scene, state) if mode.angular_frequency > 0]
    return min(found) if found and min(found) > limit else None


def fastest(scene: Scene, mass: np.ndarray) -> float:
    """A bound on the angular frequencies by the springs, rad/s: omega^2 <= 2 sum of ks / m at the stiffest particle."""
    total = np.zeros(len(mass))
    for force in scene.forces:
        if isinstance(force, Springs) and len(force.edges):
            pairs = np.asarray(force.edges[:])
            ks = np.broadcast_to(np.asarray(force.at(0.0).ks, float), (len(pairs),))
            for end in (0, 1):
                np.add.at(total, pairs[:, end], ks)
    with np.errstate(all="ignore"):
        return float(np.sqrt(2 * np.nanmax(np.where(np.isfinite(mass), total / mass, 0), initial=0)))
