"""The fit of a model to a measurement: start, descent, bounds at zero, intervals."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.component import replace
from jeuler.commands.linear_start import (
    delay_start,
    driven_start,
    equation_of_motion,
    network_start,
    state_start,
    undelayed,
    without_drift,
)
from jeuler.commands.model import Model
from jeuler.commands.selection import Measurement
from jeuler.fitting import fit
from jeuler.fitting.observations import horizons
from jeuler.fitting.oscillation import Mode, Oscillation, estimate_oscillation, modes, modes_of
from jeuler.fitting.spectrum import strong_lines
from jeuler.fitting.unknowns import Layout

STEPS_A_PERIOD, FEWER_STEPS = 80, 40  # FEWER_STEPS where the run would take more than MANY_STEPS in all
MANY_STEPS = 100_000
MOST_STEPS = 1_000_000
MOST_POINTS = 4000  # that are drawn
NOT_NEGATIVE = ("kd", "quadratic", "dry")


@dataclasses.dataclass(frozen=True)
class Estimate:
    """The result of a fit.

    Attributes:
      model, params: the model and its parameters.
      stderr: of the same structure, for residuals correlated as these are; inf where not determined.
      widening: the factor by which standard errors are larger than for white residuals.
      at_zero: the parameters that ended at their bound 0, in words.
      predicted: at the measured times, (time, particle, dim).  curve: times, (t,), and what is observed at the model's
        own steps, (t, particle, dim), thinned to be drawn.  dt: step size, s.
      loss: mean square of the residual.  iterations, converged, message: of the descent.  mass: as fitted.
      correlation: names of the fitted numbers and the correlation of their errors.  history: the loss.
    """

    model: Model
    params: dict[str, Any]
    stderr: dict[str, Any]
    widening: float
    at_zero: tuple[str, ...]
    predicted: np.ndarray
    curve: tuple[np.ndarray, np.ndarray]
    dt: float
    loss: float
    iterations: int
    converged: bool
    message: str
    mass: np.ndarray
    correlation: tuple[tuple[str, ...], np.ndarray] | None = None
    history: Any = ()

    @property
    def modes(self) -> list[Mode]:
        """Modes of the linear part of the model; about the mean position where positions are places."""
        if not self.model.places:
            ks = np.atleast_1d(self.params["ks"])
            kd = np.atleast_1d(self.params.get("kd", np.zeros_like(ks)))
            each = modes_of(equation_of_motion(self.model, ks, kd, self.mass))
            return each[:1] if self.model.shared and len(set(self.mass.tolist())) == 1 else each
        scene, state = self.model.scene(self.params)
        position = np.concatenate([self.predicted.mean(axis=0), self.params["anchors"]])
        return modes(scene, replace(state, position=jnp.asarray(position)))


def guess_of(measured: Measurement) -> Oscillation:
    """Frequency and decay of the strongest line; a slower one than the record is a drift if another is there."""

    def strongest(record: Measurement) -> Oscillation:
        try:
            return estimate_oscillation(record.times, record.positions.reshape(len(record.times), -1))
        except ValueError as error:
            raise ValueError(f"{record.source}: {error}") from None

    cycle = 2 * np.pi / (float(np.ptp(measured.times)) or 1.0)
    found = strongest(measured)
    if found.angular_frequency > 1.2 * cycle:
        return found
    faster = strongest(without_drift(measured, 2))
    return faster if faster.angular_frequency > 2 * cycle else found


def step_size(measured: Measurement, guess: Oscillation, asked: float | None) -> float:
    """An 80th of the shortest period, a 40th in a very long record; at most a 100th of the record. Or as asked."""
    flat = measured.positions.reshape(len(measured.times), -1)
    lines = [omega for column in flat.T for omega, _ in strong_lines(measured.times, column)]
    period = 2 * np.pi / max([guess.angular_frequency, *(o for o in lines if o < 8 * guess.angular_frequency)])
    span = float(np.ptp(measured.times))
    if asked is None:
        steps = STEPS_A_PERIOD if span / period * STEPS_A_PERIOD <= MANY_STEPS else FEWER_STEPS
        return min(period / steps, span / 100)
    if asked > period / 10:
        raise ValueError(f"--dt {asked:g}: must be below a tenth of the period of {period:.3g} s; leave it out")
    if span / asked > MOST_STEPS:
        raise ValueError(
            f"--dt {asked:g}: {span / asked:.3g} steps over {span:.3g} s, at most {MOST_STEPS}; leave it out"
        )
    return asked


def starting_values(
    model: Model, measured: Measurement, guess: Oscillation, asked: dict[str, float]
) -> tuple[dict[str, Any], bool]:
    """Where the search starts, and whether it should lengthen the fitted time in stages, as the model is not linear."""
    mean_mass = float(np.nanmean(model.mass))
    springs = 1 if (model.shared or model.pendulum or model.cubic) else len(model.labels)
    omega = guess.angular_frequency
    if model.pendulum:
        swing = np.nanmax(np.abs(measured.positions - np.nanmean(measured.positions, axis=0)))
        omega = omega / max(1 - min(swing, 2.5) ** 2 / 16, 0.5)
    ks = np.full(springs, asked.get("ks", mean_mass * omega**2))
    kd = np.full(springs, asked.get("kd", 2 * mean_mass * guess.decay_rate))
    mass = np.where(np.isnan(model.mass), mean_mass, model.mass)
    own = 0.0
    if model.spring_mass and not asked and not np.isnan(model.mass).any():
        ks[:], own = _one_spring(model, measured)
    coupled = bool(model.pairs) and not model.places
    start: dict[str, Any] = {}
    if model.delay and not model.places:
        late = delay_start(model, without_drift(measured, model.drift), guess)
        start |= {"delay": late[np.isnan(model.delay)]} if np.isnan(model.delay).any() else {}
        measured = undelayed(measured, late)
    if coupled and model.dim == 1 and model.observe in ("position", "angle") and not asked:
        ks, kd, mass, _ = network_start(model, without_drift(measured, model.drift), guess)
        ks = np.maximum(ks, 1e-6 * ks.max())
    start |= {"ks": ks, "kd": kd}
    if model.drive is not None:
        start |= driven_start(model, without_drift(measured, model.drift), guess)[0]
    elif model.places:
        start |= _places(model, measured)
        if np.isnan(model.delay).any():
            start["delay"] = np.zeros(np.isnan(model.delay).sum())
    else:
        start |= state_start(model, measured, ks, kd, np.maximum(mass + own, 1e-9))
    if np.isnan(model.mass).any():
        start["mass"] = mass[np.isnan(model.mass)]
    if model.spring_mass:
        start["spring_mass"] = np.asarray(own)
    speed = max(model.slow * 50, 1e-12)
    if "quadratic" in model.friction:
        start["quadratic"] = np.asarray(0.3 * kd.mean() / speed)
    if "dry" in model.friction:
        start["dry"] = np.asarray(0.3 * kd.mean() * speed)
    if "viscous" not in model.friction:
        del start["kd"]
    if model.cubic and "cubic" not in start:
        start["cubic"] = np.asarray(0.0)
    if model.drift and "drift" not in start:
        start["drift"] = np.zeros((model.drift, model.particles, model.dim))
    return start, model.pendulum or model.places or model.cubic or bool(asked) or (coupled and model.dim > 1)


def _one_spring(model: Model, measured: Measurement) -> tuple[float, float]:
    """ks and the spring's own mass from the frequency of each recording: ks = (mass + own) omega^2, least squares."""
    squares = np.array(
        [
            estimate_oscillation(measured.times, column).angular_frequency ** 2
            for column in measured.positions.swapaxes(0, 1)
        ]
    )
    design = np.stack([np.ones_like(squares), -squares], axis=1)
    ks, own = np.linalg.lstsq(design / squares[:, None], model.mass, rcond=None)[0]
    if ks > 0 and 0 < own < model.mass.mean():
        return float(ks), float(own)
    return float(np.mean(model.mass * squares)), 0.0


def _places(model: Model, measured: Measurement) -> dict[str, Any]:
    rest = np.nanmean(measured.positions, axis=0)
    seen = np.isfinite(measured.positions).all(axis=2)
    first = [measured.positions[np.argmax(seen[:, k]), k] if seen[:, k].any() else rest[k] for k in range(len(rest))]
    i, j = np.array(model.pairs).T
    lengths = np.nanmean(np.linalg.norm(measured.positions[:, i] - measured.positions[:, j], axis=-1), axis=0)
    return {
        "position": np.stack(first),
        "velocity": np.zeros_like(rest),
        "anchors": rest[list(model.anchored)],
        "rest_length": lengths,
    }


def estimate(
    model: Model,
    measured: Measurement,
    guess: Oscillation,
    dt: float,
    asked: dict[str, float],
    max_iterations: int,
    simpler: Estimate | None = None,
) -> Estimate:
    """Fit the model; coefficients that come out negative and cannot be are held at 0, and the rest is fitted again.

    It starts where a simpler model ended, if one is given: what that lacks is 0.
    """
    start, grow = starting_values(model, measured, guess, asked)
    if simpler is not None:
        start = {name: np.asarray(simpler.params.get(name, np.zeros_like(value))) for name, value in start.items()}
    unknowns, samples = sum(np.size(x) for x in start.values()), int(np.isfinite(measured.positions).sum())
    if samples <= unknowns:
        raise ValueError(
            f"{measured.source}: {samples} values cannot determine {unknowns} unknowns ({', '.join(start)}); "
            f"record more"
        )
    scale = _scales(model, measured, guess, start)
    held: dict[str, Any] = {}
    params, stage = start, grow
    for _ in range(4):
        found = _descend(model, measured, params, held, scale, dt, stage, max_iterations)
        below = {name: np.asarray(found.params[name]) < 0 for name in NOT_NEGATIVE if name in found.params}
        held, before = {name: held.get(name, False) | mask for name, mask in below.items()}, held
        if not any(mask.any() for mask in below.values()):
            held = before
            break
        params = {k: np.where(held[k], 0.0, v) if k in held else np.asarray(v) for k, v in found.params.items()}
        stage = False
    predicted, curve = _motion(model, measured, found.params, held, dt)
    stderr = {name: np.asarray(error) for name, error in found.stderr.items()}
    return Estimate(
        model=model,
        params={name: np.where(held.get(name, False), 0.0, value) for name, value in found.params.items()},
        stderr=stderr,
        widening=_widening(found),
        at_zero=_held_words(model, held),
        predicted=predicted,
        curve=curve,
        dt=dt,
        loss=float(found.loss),
        iterations=len(found.history),
        converged=bool(found.converged),
        message="converged" if found.converged else f"not converged in {len(found.history)} iterations",
        mass=np.asarray(model.masses(found.params)),
        correlation=None if found.covariance is None else (Layout.of(found.params).names(), found.correlation),
        history=found.history,
    )


def _held_words(model: Model, held: dict[str, Any]) -> tuple[str, ...]:
    """What is held at 0, in words."""
    words = {"quadratic": "quadratic drag", "dry": "dry friction"}
    names = [words[name] for name in words if np.any(held.get(name, False))]
    springs = [label for label, mask in zip(model.labels, np.atleast_1d(held.get("kd", False)), strict=False) if mask]
    if springs:
        names.append("damping kd" + (f" of {', '.join(springs)}" if len(model.labels) > 1 else ""))
    return tuple(names)


def _scales(model: Model, measured: Measurement, guess: Oscillation, start: dict[str, Any]) -> dict[str, Any]:
    """The typical size of a change of each parameter."""
    ks = float(np.max(start["ks"]))
    omega = guess.angular_frequency
    spread = float(np.nanstd(measured.positions)) or 1.0
    amplitude = {"acceleration": spread / omega**2, "velocity": spread / omega, "angular velocity": spread / omega}.get(
        model.observe, spread
    )
    return {
        "ks": 0.3 * ks,
        "kd": 0.1 * ks / omega,
        "position": amplitude,
        "velocity": amplitude * omega,
        "offset": spread,
        "drift": spread,
        "delay": 0.1 / omega,
        "anchors": amplitude,
        "rest_length": amplitude,
        "mass": 0.3 * float(np.nanmean(model.mass)),
        "spring_mass": 0.1 * float(np.nanmean(model.mass)),
        "quadratic": 0.1 * ks / omega / (amplitude * omega),
        "dry": 0.1 * ks * amplitude,
        "cubic": 0.3 * ks / amplitude**2,
        "gain": max(ks * amplitude / (float(np.std(measured.drive)) or 1.0), 1e-300)
        if measured.drive is not None
        else 1.0,
    }


def _descend(
    model: Model,
    measured: Measurement,
    start: dict[str, Any],
    held: dict[str, Any],
    scale: dict[str, Any],
    dt: float,
    grow: bool,
    max_iterations: int,
) -> Any:
    seen = np.nonzero(np.isfinite(measured.positions))
    targets = jnp.asarray(measured.positions[seen])
    begin, _ = model.grid(measured.times, dt)

    def predict(params: dict[str, Any]) -> jax.Array:
        return model.predict(_with_zeros(params, held), measured.times, dt)

    return fit(
        lambda params: predict(params)[seen] - targets,
        {name: jnp.asarray(value, float) for name, value in start.items()},
        scale={name: scale[name] for name in start},
        stages=horizons(measured.times[seen[0]] - begin) if grow else (),
        max_iterations=max_iterations,
        tolerance=1e-7,
        progress=False,
    )


def _with_zeros(params: dict[str, Any], held: dict[str, Any]) -> dict[str, Any]:
    return {k: jnp.where(jnp.asarray(held[k]), 0.0, v) if k in held else v for k, v in params.items()}


def _motion(
    model: Model, measured: Measurement, params: dict[str, Any], held: dict[str, Any], dt: float
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """What is observed at the measured times; and at the steps, with their times."""
    begin, steps = model.grid(measured.times, dt)
    every = max(1, steps // (2 * MOST_POINTS))

    @jax.jit
    def observed(params: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        return model.predict_and_trace(_with_zeros(params, held), measured.times, dt, every)

    predicted, at_steps = map(np.asarray, observed(params))
    return predicted, (begin + dt * np.arange(steps + 1)[::every], at_steps)


def _widening(found: Any) -> float:
    """The factor by which the errors of ks are larger than for white residuals; the largest of all springs."""
    wide, white = (np.ravel(errors["ks"]) for errors in (found.stderr, found.stderr_white))
    known = np.isfinite(wide) & np.isfinite(white) & (white > 0)
    return float(np.max(wide[known] / white[known])) if known.any() else 1.0
