"""What an oscillation says at a glance: its frequency and decay from the data, its modes from a scene."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jeuler.fitting.spectrum import periodogram, power_spectrum, refined_line, seen_samples
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState


class Oscillation(NamedTuple):
    """Angular frequency, rad/s, and decay rate of the amplitude, 1/s."""

    angular_frequency: float
    decay_rate: float


EXACT_ROWS = 500  # a Lomb-Scargle periodogram costs rows squared; beyond this the FFT is as good and far cheaper


def estimate_oscillation(times: np.ndarray, values: np.ndarray) -> Oscillation:
    """The strongest line in the spectrum of (time, column) data, and how fast the motion dies away.

    A start for a fit: the frequency to about a tenth of a line's width, the decay from the two halves of the record.
    NaN = not observed; the sampling may be uneven. Memory grows as the rows.
    """
    span = times[-1] - times[0]
    moving = [c for c in values.T if np.isfinite(c).sum() >= 4 and np.ptp(c[np.isfinite(c)]) > 0]
    if not moving or span <= 0:
        raise ValueError(
            f"nothing moves: no column fitted has 4 values that are not all equal in its {len(times)} rows, "
            f"and an oscillation cannot be fitted to that"
        )
    omega = _strongest_line(times, moving, span)
    decays = [decay for column in moving if (decay := _decay(times, column, span)) is not None]
    decay = float(np.median(decays)) if decays else 0.0
    return Oscillation(omega, float(np.clip(decay, 0.0005 * omega, 0.7 * omega)))


def _strongest_line(times: np.ndarray, columns: list[np.ndarray], span: float) -> float:
    if len(times) <= EXACT_ROWS:
        samples = [seen_samples(times, column) for column in columns]
        cycles = np.arange(0.4, max(max(len(t) for t, _ in samples) / 2, 2), 0.1)
        frequencies = 2 * np.pi / span * cycles
        return float(frequencies[np.argmax(sum(periodogram(*sample, frequencies) for sample in samples))])
    frequencies, power = power_spectrum(times, columns[0], span)
    for column in columns[1:]:
        power = power + np.interp(frequencies, *power_spectrum(times, column, span), right=0.0)
    return refined_line(times, columns, float(frequencies[np.argmax(power)]), span)


def _decay(times: np.ndarray, column: np.ndarray, span: float) -> float | None:
    """The decay rate from the sizes of the two halves; None where one has no motion."""
    t, x = seen_samples(times, column)
    early, late = x[t < t[0] + span / 2], x[t >= t[0] + span / 2]
    if len(early) < 2 or len(late) < 2 or not early.std() > 0 or not late.std() > 0:
        return None
    return float(np.log(early.std() / late.std()) / (span / 2))


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
        v, a = scene.without_effects().vector_field(0.0, y, state.mass)
        return v[free], a[free]

    at = state.position[free], state.velocity[free] * 0
    (xx, xv), (vx, vv) = jax.jit(jax.jacfwd(slope))(at)
    n = at[0].size
    return modes_of(np.block([[np.reshape(b, (n, n)) for b in row] for row in ((xx, xv), (vx, vv))]))


def modes_of(matrix: np.ndarray) -> list[Mode]:
    """The modes of the linear equation of motion y' = matrix y, y = (position, velocity), slowest first."""
    eigenvalues = np.linalg.eigvals(matrix)
    tiny = 1e-6 * np.abs(eigenvalues).max(initial=0)
    swinging = [s for s in eigenvalues if s.imag > tiny]
    creeping = sorted(-s.real for s in eigenvalues if abs(s.imag) <= tiny and s.real < -tiny)
    found = [Mode(abs(s), -s.real / abs(s)) for s in swinging]
    while len(creeping) >= 2:
        slow, fast = creeping.pop(0), creeping.pop()
        found.append(Mode(np.sqrt(slow * fast), (slow + fast) / (2 * np.sqrt(slow * fast))))
    return sorted(found)
