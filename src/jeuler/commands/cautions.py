"""What may be wrong with a fit, as sentences with what to do."""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from jeuler.commands.estimate import Estimate
from jeuler.commands.linear_start import without_drift
from jeuler.commands.selection import Measurement
from jeuler.fitting.oscillation import Oscillation
from jeuler.fitting.recordings.table import counted, listed
from jeuler.fitting.spectrum import strong_lines

LARGE_RESIDUAL = 0.02  # of the spread of the data
STILL_ROWS = 5  # fewer without motion may be chance
DRIFT = 0.3  # of the residual's variance in a slow polynomial: the zero drifts
LARGE_ANGLE = 0.35  # rad: the period of a pendulum is 0.8 % longer there


def cautions(measured: Measurement, found: Estimate, guess: Oscillation, mass_given: bool) -> list[str]:
    """The warnings that apply to this fit, one sentence each."""
    sentences = [*measured.warnings]
    if not mass_given:
        sentences.append(
            "No --mass was given: 1 kg is assumed for each particle, so ks and kd are per kilogram; give --mass."
        )
    sentences += _sampling_words(measured, guess)
    sentences += _motion_words(measured, found, guess)
    sentences += _residual_words(measured, found, guess)
    sentences += _parameter_words(found)
    sentences += _step_words(found)
    return sentences


def _sampling_words(measured: Measurement, guess: Oscillation) -> Iterator[str]:
    period = 2 * np.pi / guess.angular_frequency
    span = float(np.ptp(measured.times))
    if span < 2 * period:
        yield f"The record holds {span / period:.1f} periods: ks and kd lean on the model; record 5 periods or more."
    step = measured.sampling.step if measured.sampling else 0.0
    repeated = measured.sampling.repeated if measured.sampling else 0
    if repeated:
        yield (
            f"{repeated} rows repeat the time of the row before: the clock is too coarse, or rows are duplicated; "
            f"export the time with more decimals."
        )
    if step > period / 4:
        yield (
            f"There are only {period / step:.1f} samples per period: a faster motion would look the same (aliasing); "
            f"record at {4 / period:.3g} Hz or more, or confirm the frequency by other means."
        )


def _motion_words(measured: Measurement, found: Estimate, guess: Oscillation) -> Iterator[str]:
    model, period = found.model, 2 * np.pi / guess.angular_frequency
    still = without_drift(measured, 2) if _trend(measured, found)[0] > DRIFT else measured
    flat = still.positions.reshape(len(measured.times), -1) - _drift(measured, found)
    if measured.quantity == "angle" and not model.pendulum:
        swing = float(np.nanmax(np.abs(flat - np.nanmean(flat, axis=0))))
        if swing > LARGE_ANGLE:
            yield (
                f"The angle reaches {np.degrees(swing):.0f} degrees: a pendulum is no linear spring there; "
                f"use --pendulum, or --from a time when it is small."
            )
    held = _held(measured.times, flat)
    if held > period / 6 and not model.drive:
        yield (
            f"Nothing moves in the first {held:.2g} s: the release is in the record, but the model starts free; "
            f"use --from {measured.times[0] + held + period / 4:.3g}."
        )
    if not model.pairs and model.drive is None:
        known = [mode.angular_frequency for mode in found.modes]
        width = 2 * np.pi / float(np.ptp(measured.times))
        lines = {round(o, 6) for column in flat.T for o, _ in strong_lines(measured.times, column)}
        left = [o for column in _residual(measured, found)[0].T for o, _ in strong_lines(measured.times, column)]
        unexplained = [
            o
            for o in lines
            if any(abs(o - r) < 3 * width for r in left)  # gaps make lines in the data that no residual has
            and all(abs(o - k * w) > max(0.1 * w, 3 * width) for w in known for k in (1, 2, 3))
        ]
        if unexplained:
            frequencies = listed([f"{o / (2 * np.pi):.3g} Hz" for o in sorted(unexplained)])
            yield (
                f"The data contain another oscillation, at {frequencies}, that the model lacks: add the particles and "
                f"springs that cause it (--edges), fit one direction (--columns), or leave it out (--from, --to)."
            )


def _drift(measured: Measurement, found: Estimate) -> np.ndarray:
    """How far the zero of each column has moved, (time, column)."""
    if not found.model.drift:
        return np.zeros((len(measured.times), 1))
    still = {"drift": found.params["drift"]}
    return np.asarray(found.model.zero(still, jnp.asarray(measured.times))).reshape(len(measured.times), -1)


def _trend(measured: Measurement, found: Estimate) -> tuple[float, float]:
    """The share of a residual's variance that a polynomial of second degree explains, and how far that moves.

    0 where a drift is fitted, or the residual is small.
    """
    residual, share = _residual(measured, found)
    if found.model.drift or share <= LARGE_RESIDUAL / 4:
        return 0.0, 0.0
    z = np.linspace(-1, 1, len(residual))
    explained, moved = 0.0, 0.0
    for column in residual.T:
        seen = np.isfinite(column)
        if seen.sum() < 10 or not np.var(column[seen]):
            continue
        slow = np.polynomial.Polynomial.fit(z[seen], column[seen], 2)(z)
        explained = max(explained, float(1 - np.var(column[seen] - slow[seen]) / np.var(column[seen])))
        moved = max(moved, float(np.ptp(slow)))
    return explained, moved


def _residual(measured: Measurement, found: Estimate) -> tuple[np.ndarray, float]:
    """Data less model, (time, column), and its root mean square as a share of the data's spread."""
    residual = (measured.positions - found.predicted).reshape(len(measured.times), -1)
    spread = float(np.nanstd(measured.positions - np.nanmean(measured.positions, axis=0)))
    return residual, float(np.sqrt(np.nanmean(residual**2))) / spread if spread else 0.0


def _held(times: np.ndarray, flat: np.ndarray) -> float:
    """How long nothing moves at the beginning, s."""
    extent = np.nanmax(flat, axis=0) - np.nanmin(flat, axis=0)
    moving = flat[:, extent >= 0.3 * np.nanmax(extent)]
    start = np.nanmedian(moving[:5], axis=0)
    away = np.abs(moving - start) > 0.05 * (np.nanmax(moving, axis=0) - np.nanmin(moving, axis=0))
    first = int(np.argmax(away.any(axis=1)))
    return float(times[first] - times[0]) if first >= STILL_ROWS else 0.0


def _residual_words(measured: Measurement, found: Estimate, guess: Oscillation) -> Iterator[str]:
    residual, share = _residual(measured, found)
    lag = lag_one(residual)
    far = _far(residual)
    if far.size and share > LARGE_RESIDUAL / 20:
        yield (
            f"{counted(far.size, 'row')} far from the model, the first at {measured.times[far[0]]:.4g} s: a knock, "
            f"a lost point or a damaged cell; look at those rows, and leave them out or empty their cells."
        )
    slow, moved = _trend(measured, found)
    if slow > DRIFT:
        yield (
            f"The zero drifts by {moved:.2g} {measured.unit}, {100 * slow:.0f} % of the residual's variance: "
            f"use --drift, or --drift 3 where it is no straight line."
        )
        return
    if share > 0.7:
        yield (
            f"The model explains only {max(0.0, 100 * (1 - share**2)):.0f} % of the variance: its numbers mean "
            f"nothing. Look at the picture and at `jeuler look`; choose other columns, another run or span."
        )
        return
    if share > LARGE_RESIDUAL and lag > 0.5:
        yield (
            f"The residual is {100 * share:.2g} % of the motion's spread and is not noise (neighbours correlate by "
            f"{lag:.2f}): the model lacks something. Try --friction compare; look at the picture for a second motion, "
            f"a release, a knock, or a drift."
        )
    early = measured.times < measured.times[0] + np.pi / guess.angular_frequency
    if early.sum() > 3 and (~early).sum() > 3 and np.isfinite(residual[early]).any():
        begin, rest = np.sqrt(np.nanmean(residual[early] ** 2)), np.sqrt(np.nanmean(residual[~early] ** 2))
        if begin > 4 * rest and share > LARGE_RESIDUAL / 4:
            yield (
                f"The first half period fits {begin / rest:.0f} times worse than the rest: it may hold the "
                f"release; use --from {measured.times[~early][0]:.3g}."
            )


def _far(residual: np.ndarray) -> np.ndarray:
    """The rows whose residual is over 8 times the median; none if these are more than 5 % of all."""
    size = np.nanmax(np.abs(residual), axis=1, initial=0, where=np.isfinite(residual))
    usual = np.median(size[size > 0]) if (size > 0).any() else 0.0
    far = np.flatnonzero(size > 8 * usual)
    return far if far.size <= 0.05 * len(size) else far[:0]


def _parameter_words(found: Estimate) -> Iterator[str]:
    if not found.converged:
        yield "The fit did not converge: raise --max-iterations, or give better starting values with --start."
    ks = np.atleast_1d(found.params["ks"])
    if (ks < 0).any():
        yield "A stiffness came out negative: the model is wrong for these data; look at the columns and --edges."
    for what in found.at_zero:
        yield f"The best {what} would be negative, so it is held at 0: the data show none, or the model lacks a drive."


def _step_words(found: Estimate) -> Iterator[str]:
    """The decay rate that the fourth-order Runge-Kutta step adds, omega (omega dt)^5 / 144, against the error of kd."""
    if "kd" not in found.params or found.model.places:
        return
    omega = max(mode.angular_frequency for mode in found.modes)
    bias = 2 * float(np.max(found.mass)) * omega * (omega * found.dt) ** 5 / 144
    kd, errors = np.atleast_1d(found.params["kd"]), np.atleast_1d(found.stderr["kd"])
    if bias > max(float(np.min(errors)), 1e-3 * float(np.min(np.abs(kd)))):
        yield (
            f"The step of {found.dt:.3g} s adds damping of its own: kd comes out too small by {bias:.2g}; "
            f"give --dt {found.dt / 2:.3g}."
        )


def lag_one(residual: np.ndarray) -> float:
    """The correlation of neighbouring samples, over all columns, weighted by their variances."""
    centred = residual - np.nanmean(residual, axis=0)
    products, squares = np.nansum(centred[1:] * centred[:-1]), np.nansum(centred**2)
    return float(products / squares) if squares > 0 else 0.0
