"""Where a fit starts: stiffness, damping and initial state of a linear model, from the data by linear least squares."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler.commands.model import Model
from jeuler.commands.selection import Measurement
from jeuler.fitting.oscillation import Oscillation
from jeuler.fitting.spectrum import strong_lines

SHIFTS = 41  # delays that are tried, over a period


def without_drift(measured: Measurement, degree: int) -> Measurement:
    """The recording without its best polynomial in time: what is left for a first guess of its oscillation."""
    if not degree:
        return measured
    positions = measured.positions.copy()
    flat = positions.reshape(len(positions), -1)
    z = 2 * (measured.times - measured.times[0]) / (np.ptp(measured.times) or 1.0) - 1
    powers = z[:, None] ** np.arange(degree + 1)
    for column in flat.T:
        seen = np.isfinite(column)
        if seen.sum() > degree + 1:
            slow = powers @ np.linalg.lstsq(powers[seen], column[seen], rcond=None)[0]
            column -= slow - np.nanmean(column)
    return dataclasses.replace(measured, positions=flat.reshape(positions.shape))


def undelayed(measured: Measurement, delay: np.ndarray) -> Measurement:
    """The recording with each channel, (time, particle, dim), that is late by `delay` put back to its time."""
    positions = measured.positions.copy()
    for k, late in enumerate(delay):
        for axis in range(positions.shape[2]):
            column = measured.positions[:, k, axis]
            seen = np.isfinite(column)
            if late and seen.any():
                at, t = measured.times + late, measured.times[seen]
                positions[:, k, axis] = np.interp(at, t, column[seen], left=np.nan, right=np.nan)
    return dataclasses.replace(measured, positions=positions)


def delay_start(model: Model, measured: Measurement, guess: Oscillation) -> np.ndarray:
    """The delay of each channel, s: of those to be fitted, one after the other, the one with the least mismatch.

    Delays of up to half a period either way are tried, each with the stiffness that suits it best.
    """
    delay = np.array(model.delay)
    unknown = np.flatnonzero(np.isnan(delay))
    delay[unknown] = 0.0
    period = 2 * np.pi / guess.angular_frequency
    for _ in range(2 if len(unknown) > 1 else 1):
        for k in unknown:
            tried = []
            for late in np.linspace(-period / 2, period / 2, SHIFTS):
                trial = delay.copy()
                trial[k] = late
                moved = undelayed(measured, trial)
                tried.append((_mismatch(model, moved, guess), abs(late), late))
            delay[k] = min(tried)[2]
    return delay


def _mismatch(model: Model, measured: Measurement, guess: Oscillation) -> float:
    if model.drive is not None:
        return driven_start(model, measured, guess)[1]
    return network_start(model, measured, guess)[3]


def network_start(
    model: Model, measured: Measurement, guess: Oscillation
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """ks and kd of each spring, the mass of each particle, by the weak form of the equation of motion; its mismatch.

        integral of w'' m x  =  - sum over springs of ks integral of w (x_i - x_j) + kd integral of w' (x_i - x_j)

    with bumps w = (1 - z^2)^4 that vanish at both ends; both sides are linear in ks, kd, unknown masses and a constant.
    For particles on one line, sampled evenly or not. ks, kd >= 0.
    """
    from scipy.optimize import lsq_linear

    lines = [
        omega
        for column in measured.positions.reshape(len(measured.times), -1).T
        for omega, _ in strong_lines(measured.times, column)
    ] or [guess.angular_frequency]
    t = measured.times
    half = max(np.pi / max(lines), 4 * float(np.median(np.diff(t))))
    centres = np.arange(t[0] + half, t[-1] - half, half / 3)
    if len(centres) < 4:
        raise ValueError("too short for the weak form")
    first, second, plain = _moments(t, measured.positions[..., 0], centres, half)
    springs = [(k, None) for k in model.anchored] + list(model.pairs)
    free = np.flatnonzero(np.isnan(model.mass))
    n, count = model.particles, len(centres)
    columns = 2 * len(springs) + len(free) + n
    matrix, right = np.zeros((n, count, columns)), np.zeros((n, count))
    for e, (i, j) in enumerate(springs):
        for particle, sign in ((i, 1.0), (j, -1.0)):
            if particle is None:
                continue
            for source, value in ((plain, e), (-first, len(springs) + e)):
                stretch = source[:, i] - (source[:, j] if j is not None else 0.0)
                matrix[particle, :, value] += sign * stretch
    for k in range(n):
        matrix[k, :, 2 * len(springs) + len(free) + k] = half  # a constant force, which sets the rest position
        if k in free:
            matrix[k, :, 2 * len(springs) + int(np.searchsorted(free, k))] = second[:, k]
        else:
            right[k] = -model.mass[k] * second[:, k]
    a, b = matrix.reshape(-1, columns), right.ravel()
    keep = np.isfinite(a).all(axis=1) & np.isfinite(b)
    if keep.sum() < 2:
        raise ValueError("too short for the weak form")
    scale = np.maximum(np.linalg.norm(a[keep], axis=0), 1e-300)
    low = np.r_[np.zeros(2 * len(springs) + len(free)), np.full(n, -np.inf)]
    solution = lsq_linear(a[keep] / scale, b[keep], (low, np.full(columns, np.inf)))
    x = solution.x / scale
    mass = np.array(model.mass)
    mass[free] = x[2 * len(springs) : 2 * len(springs) + len(free)]
    return x[: len(springs)], x[len(springs) : 2 * len(springs)], mass, 2 * solution.cost / keep.sum()


def driven_start(model: Model, measured: Measurement, guess: Oscillation) -> tuple[dict[str, Any], float]:
    """ks, kd, cubic and gain of one particle under a measured input, by the weak form, and its mismatch.

    The initial velocity is 0. Where the support moves, ks and kd act on the distance from it, and there is no gain.
    """
    half = max(np.pi / guess.angular_frequency, 4 * float(np.median(np.diff(measured.times))))
    t, x, u = measured.times, measured.positions[:, 0, 0], np.asarray(measured.drive)
    amplitude = np.nanmax(np.abs(x - np.nanmean(x)))
    away = x - np.nanmean(x) - (u - u.mean() if model.moves_support else 0.0)
    away, moved = away / amplitude, (x - np.nanmean(x)) / amplitude
    columns = np.stack([away, away**3, u, moved], axis=1)
    centres = np.arange(t[0] + half, t[-1] - half, half / 3)
    first, second, plain = _moments(t, columns, centres, half)
    design = [-plain[:, 0], first[:, 0], np.full(len(centres), half)]
    if not model.moves_support:
        design.append(plain[:, 2])
    if model.cubic:
        design.append(-plain[:, 1])
    a, b = np.stack(design, axis=1), float(model.mass[0]) * second[:, 3]
    keep = np.isfinite(a).all(axis=1) & np.isfinite(b)
    if keep.sum() <= a.shape[1]:
        raise ValueError(f"{measured.source}: too short for a measured input: record 5 periods or more")
    scale = np.maximum(np.linalg.norm(a[keep], axis=0), 1e-300)
    found = np.linalg.lstsq(a[keep] / scale, b[keep], rcond=None)[0] / scale
    start = {
        "ks": found[:1],
        "kd": np.maximum(found[1:2], 0.0),
        "position": np.array([[x[np.isfinite(x)][0] - np.nanmean(x)]]),
        "velocity": np.zeros((1, 1)),
        "offset": np.array([[np.nanmean(x)]]),
    }
    if not model.moves_support:
        start["gain"] = np.asarray(found[3] * amplitude)
    if model.cubic:
        start["cubic"] = np.asarray(found[-1] / amplitude**2)
    mismatch = np.mean((a[keep] @ found - b[keep]) ** 2)
    return start, float(mismatch)


def band_limited(times: np.ndarray, samples: np.ndarray, finer: int = 8) -> tuple[np.ndarray, float, float]:
    """A measured force on a clock ``finer`` times as fine, by band-limited interpolation; its first time and step."""
    from scipy.signal import resample_poly

    step = float(np.ptp(times)) / (len(times) - 1)
    fine = resample_poly(samples, finer, 1, window=("kaiser", 8.0), padtype="line")
    return fine, float(times[0]), step / finer


def _moments(
    t: np.ndarray, x: np.ndarray, centres: np.ndarray, half: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrals of w' x, w'' x and w x over each bump, (bump, particle); NaN where a bump meets a gap."""
    sums = np.full((3, len(centres), x.shape[1]), np.nan)
    for c, centre in enumerate(centres):
        inside = np.flatnonzero(np.abs(t - centre) < half)
        if len(inside) < 5:
            continue
        z = (t[inside] - centre) / half
        weights = np.gradient(t[inside])[:, None]
        bump = np.stack(
            [
                -8 * z * (1 - z**2) ** 3 / half,
                (-8 * (1 - z**2) ** 3 + 48 * z**2 * (1 - z**2) ** 2) / half**2,
                (1 - z**2) ** 4,
            ]
        )
        piece = np.where(np.isfinite(x[inside]), x[inside], np.nan)
        sums[:, c] = bump @ (piece * weights)
    return sums[0], sums[1], sums[2]


def equation_of_motion(model: Model, ks: np.ndarray, kd: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """The matrix of y' = matrix y, y = (displacements, velocities) along one coordinate."""
    n = model.particles
    stiffness, damping = np.zeros((n, n)), np.zeros((n, n))
    edges = [(k, None) for k in model.anchored] + list(model.pairs)
    for e, (i, j) in enumerate(edges):
        for matrix, value in ((stiffness, ks), (damping, kd)):
            strength = value[min(e, len(value) - 1)]
            matrix[i, i] += strength
            if j is not None:
                matrix[j, j] += strength
                matrix[i, j] -= strength
                matrix[j, i] -= strength
    return np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness / mass[:, None], -damping / mass[:, None]]])


def state_start(
    model: Model, measured: Measurement, ks: np.ndarray, kd: np.ndarray, mass: np.ndarray
) -> dict[str, Any]:
    """Initial position, velocity, offset and drift of each particle: the linear model nearest to the data."""
    n = model.particles
    system = equation_of_motion(model, ks, kd, mass)
    system = system + 1e-9 * np.abs(system).max() * np.diag(np.arange(2 * n))  # no two eigenvalues equal
    values, vectors = np.linalg.eig(system)
    t = measured.times - measured.times[0] + model.reach
    modal = np.exp(np.clip(values[None, :].real, None, 0) * t[:, None] + 1j * values[None, :].imag * t[:, None])
    flow = np.einsum("am,tm,mb->tab", vectors, modal, np.linalg.inv(vectors)).real
    if model.observe in ("position", "angle"):
        rows = flow[:, :n]
    elif model.observe in ("velocity", "angular velocity"):
        rows = flow[:, n:]
    else:
        rows = np.einsum("ab,tbc->tac", system[n:], flow)
    start = np.zeros((2 * n, model.dim))
    z = 2 * (measured.times - measured.times[0]) / np.ptp(measured.times) - 1
    powers = np.einsum("td,pq->tpdq", z[:, None] ** np.arange(model.drift + 1), np.eye(n)).reshape(len(t), n, -1)
    zero = np.zeros((model.drift + 1, n, model.dim))
    for axis in range(model.dim):
        observed = measured.positions[..., axis]
        design = np.concatenate([rows, powers], axis=2).reshape(len(t) * n, -1)
        target = observed.reshape(-1)
        seen = np.isfinite(target)
        solution = np.linalg.lstsq(design[seen], target[seen], rcond=1e-10)[0]
        start[:, axis], zero[..., axis] = solution[: 2 * n], solution[2 * n :].reshape(-1, n)
    found = {"position": start[:n], "velocity": start[n:], "offset": zero[0]}
    return found | ({"drift": zero[1:]} if model.drift else {})
