"""What an oscillation says at a glance: its frequency and decay from the data, its modes from a scene."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState


class Oscillation(NamedTuple):
    """Angular frequency, rad/s, and decay rate of the amplitude, 1/s."""

    angular_frequency: float
    decay_rate: float


def estimate_oscillation(times: np.ndarray, values: np.ndarray) -> Oscillation:
    """The strongest line in the spectrum of (time, column) data, and how fast the motion dies away.

    A start for a fit: the frequency to about a tenth of a line's width, the decay from the two halves of the record.
    NaN = not observed; the sampling may be uneven (Lomb-Scargle periodogram).
    """
    from scipy.signal import lombscargle

    span = times[-1] - times[0]
    frequencies = 2 * np.pi / span * np.arange(0.4, max(len(times) / 2, 2), 0.1)
    power = np.zeros_like(frequencies)
    decays = []
    for column in values.T:
        seen = np.isfinite(column)
        if seen.sum() < 4 or np.ptp(column[seen]) == 0:
            continue
        t, x = times[seen], column[seen] - column[seen].mean()
        power += lombscargle(t, x, frequencies)
        early, late = t < t[0] + span / 2, t >= t[0] + span / 2
        if early.sum() > 1 and late.sum() > 1 and x[late].std() > 0:
            decays.append(np.log(x[early].std() / x[late].std()) / (span / 2))
    omega = float(frequencies[np.argmax(power)])
    decay = float(np.median(decays)) if decays else 0.0
    return Oscillation(omega, float(np.clip(decay, 0.005 * omega, 0.7 * omega)))


class Mode(NamedTuple):
    """A mode of the linearised motion: undamped angular frequency, rad/s, and damping ratio, 1."""

    angular_frequency: float
    damping_ratio: float


def modes(scene: Scene, state: ParticleState) -> list[Mode]:
    """The modes of the scene linearised at the state, from the eigenvalues s of its equation of motion, slowest first.

        s = omega (-z +- sqrt(z^2 - 1)):   omega = |s|,  z = -Re s / |s|

    An overdamped mode has two real eigenvalues, s1 s2 = omega^2 and -(s1 + s2) = 2 z omega; they are paired by size.
    """
    free = np.flatnonzero(np.broadcast_to(np.isfinite(np.asarray(state.mass)), state.position.shape[:1]))

    def slope(moving: Any) -> Any:
        position, velocity = moving
        y = state.position.at[free].set(position), state.velocity.at[free].set(velocity)
        v, a = scene.vector_field(0.0, y, state.mass)
        return v[free], a[free]

    at = state.position[free], state.velocity[free] * 0
    (xx, xv), (vx, vv) = jax.jit(jax.jacfwd(slope))(at)
    n = at[0].size
    matrix = np.block([[np.reshape(b, (n, n)) for b in row] for row in ((xx, xv), (vx, vv))])
    eigenvalues = np.linalg.eigvals(matrix)
    tiny = 1e-6 * np.abs(eigenvalues).max(initial=0)
    swinging = [s for s in eigenvalues if s.imag > tiny]
    creeping = sorted(-s.real for s in eigenvalues if abs(s.imag) <= tiny and s.real < -tiny)
    found = [Mode(abs(s), -s.real / abs(s)) for s in swinging]
    while len(creeping) >= 2:
        slow, fast = creeping.pop(0), creeping.pop()
        found.append(Mode(np.sqrt(slow * fast), (slow + fast) / (2 * np.sqrt(slow * fast))))
    return sorted(found)
