"""``multiple_shooting``: parameters of an ODE from records too long or too chaotic for one run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting._fit import fit
from jeuler.fitting.observations import checked_observations, noise_of
from jeuler.fitting.result import Fit
from jeuler.fitting.segments import Segments, Shooting
from jeuler.steps.explicit import Step, rk4_step

PyTree = Any

USUAL = 60  # segments
FEWEST_SAMPLES = 5  # in a segment
WEIGHTS = tuple(10.0**k for k in range(8))  # of the gaps: sizes of the motion over these are one standard error
CLOSED = 1e-4  # of the motion: gaps below this are closed


@result
class ShootingFit:
    """What `multiple_shooting` found.

    Attributes:
      params: the parameters, of the structure that was given.
      stderr: their standard errors.
      starts: the state at the start of each segment, (segment, number).
      start_times: when that is, (segment,), s.
      predicted: the states at the times, each by the segment that it is in, (time, number).
      gaps: between the end of each segment and the start of the next, over the size of the motion, (segment - 1,).
      stages: the largest gap after each weight, and the states then, (weight, largest gap, predicted).
      converged: whether the gaps are closed and the last fit is at a minimum.
      fit: the last `Fit`, with the segments' starts among its parameters.
      message: that in words.
    Example:
      >>> import jax.numpy as jnp, numpy as np, jeuler
      >>> t = np.linspace(0.0, 10.0, 201)
      >>> found = jeuler.multiple_shooting(lambda t, y, p: -p * y, 2.0, t, np.exp(-0.5 * t)[:, None], dt=0.05)
      >>> isinstance(found, jeuler.ShootingFit), round(float(found.params), 3)
      (True, 0.5)
    """

    _: dataclasses.KW_ONLY
    params: PyTree
    stderr: PyTree
    starts: np.ndarray
    start_times: np.ndarray
    predicted: np.ndarray
    gaps: np.ndarray
    stages: tuple[tuple[float, float, np.ndarray], ...]
    converged: bool
    fit: Fit
    message: str


@says_what_to_write(data="values", initial="y0=...")
def multiple_shooting(
    f: Callable[[Any, Any, PyTree], Any],
    params: PyTree,
    times: Any,
    values: Any,
    *,
    dt: float,
    y0: Any = None,
    segments: int | None = None,
    guess: Any = None,
    sigma: Any = None,
    bounds: PyTree = None,
    step: Step = rk4_step,
    max_iterations: int = 100,
) -> ShootingFit:
    """Fit the parameters of an ODE to a long or chaotic record, cut into segments whose ends have to meet.

        minimise  sum |y(t_k) - value_k|^2 / sigma^2 + w^2 sum |y_j(end) - s_(j+1)|^2 / size^2,   w = 1, 10, ... 10^7

    The state s_j at the start of each segment is an unknown that starts from the data, so that no run is long enough to
    leave the record; the weight w of the gaps between segments grows until they are closed.

    Args:
      f: ``f(t, y, params) -> dy``, y of shape (number,).
      params: starting values, any pytree of numbers.
      times: when the values were measured, (time,), s.
      values: the state, (time, number); NaN = not observed.
      dt: the longest step of the runs, s; a whole number of steps leads from one time to the next.
      y0: the state at the first time, (number,), if it is known; None fits it.
      segments: how many; None takes 60, or fewer so that each has five samples.
      guess: states to start from, (time, number), for numbers that were not observed at any time; of the others the
        values are taken.
      sigma: the noise of the values, a number or (number,); None estimates it.
      bounds: of the parameters, as in `fit`.
      step: the method, as in `solve`.
      max_iterations: the most for each weight.
    Returns: `ShootingFit`.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, numpy as np, jeuler
      >>> t = np.linspace(0.0, 20.0, 401)  # a pendulum of length 1 m and small swings
      >>> swing = 0.01 * np.stack([np.cos(np.sqrt(9.81) * t), -np.sqrt(9.81) * np.sin(np.sqrt(9.81) * t)], axis=1)
      >>> pendulum = lambda t, y, p: jnp.stack([y[1], -p["g"] * jnp.sin(y[0])])
      >>> found = jeuler.multiple_shooting(pendulum, {"g": 4.0}, t, swing, dt=0.01)
      >>> round(float(found.params["g"]), 2), found.converged
      (9.81, True)

    Source: H. G. Bock, Recent advances in parameter identification techniques for ODE, 1983.
    """
    checks.function("f", f, "(t, y, params) -> dy", "as in solve")
    checks.positive("dt", dt, "s")
    checks.untraced("multiple_shooting", times, values, params)
    x = checks.reals("values", values, "numbers of shape (time, number)")
    if x.ndim != 2 or not x.shape[1]:
        raise ValueError(f"values must have shape (time, number), got {x.shape}; one number is values[:, None]")
    t = checks.reals("times", times, "numbers of shape (time,), s")
    if t.ndim == 1 and len(t) != len(x):
        raise ValueError(f"values must have a row for each of the {len(t)} times, got {x.shape}")
    t, x = checked_observations(t, x, x.shape[1:], float(np.min(t)) if t.size else 0.0, "values")
    checks.increasing("times", t)
    number = _number_of_segments(segments, len(t))
    cut = Segments.of(len(t), number)
    filled = _filled(t, x, guess)
    checks.vector_field(f, t[0], jnp.asarray(filled[0]), params)
    sigma, size = _noise(t, x, filled, sigma)
    first = None if y0 is None else checks.reals("y0", y0, f"numbers of shape ({x.shape[1]},)")
    if first is not None and first.shape != x.shape[1:]:
        raise ValueError(f"y0 must have shape {x.shape[1:]}, got {first.shape}")
    residual = Shooting(f, step, max(1, int(np.ceil(np.diff(t).max() / dt * (1 - 1e-9)))), first is not None)
    starts = filled[cut.starts]
    data = {
        "times": t[cut.rows],
        "values": np.where(np.isfinite(x), x, 0)[cut.rows],
        "observed": (np.isfinite(x)[cut.rows]) & cut.own[..., None],
        "sigma": sigma,
        "size": size,
        "first": starts[0] if first is None else first,
        "weight": np.asarray(0.0),
    }
    unknowns = {"params": params, "starts": jnp.asarray(starts if first is None else starts[1:])}
    bounds = None if bounds is None else {"params": bounds}
    return _closed(residual, unknowns, data, cut, t, bounds, max_iterations)


def _closed(
    residual: Shooting, unknowns: Any, data: Any, cut: Segments, t: np.ndarray, bounds: Any, most: int
) -> ShootingFit:
    """Fits with a growing weight of the gaps."""
    stages: list[tuple[float, float, np.ndarray]] = []
    runs_of = jax.jit(residual.runs)
    for weight in WEIGHTS:
        data = data | {"weight": np.asarray(weight)}
        found = fit(
            residual, unknowns, data=data, sigma=1.0, bounds=bounds, max_iterations=most, progress=False, tolerance=1e-3
        )
        unknowns = found.params
        runs = np.asarray(runs_of(unknowns, data), float)
        starts = np.asarray(residual.starts(unknowns, data), float)
        gaps = np.max(np.abs(runs[:-1, -1] - starts[1:]) / data["size"], axis=1)
        predicted = np.empty((len(t), starts.shape[1]))
        predicted[cut.rows[cut.own]] = runs[cut.own]
        stages.append((weight, float(gaps.max(initial=0)), predicted))
        if stages[-1][1] < CLOSED:
            break
    closed = stages[-1][1] < CLOSED
    state = "closed" if closed else "not closed"
    words = [f"the gaps between {len(starts)} segments are {state}: at most {stages[-1][1]:.2g} of the motion"]
    words = words if len(starts) > 1 else ["one segment"]
    if not closed:
        words.append("the equations do not describe the record throughout, or more segments are needed")
    return ShootingFit(
        params=found.params["params"],
        stderr=None if found.stderr is None else found.stderr["params"],
        starts=starts,
        start_times=t[cut.starts],
        predicted=predicted,
        gaps=gaps,
        stages=tuple(stages),
        converged=bool(found.converged and closed),
        fit=found,
        message="; ".join([*words, found.message]),
    )


def _number_of_segments(segments: int | None, samples: int) -> int:
    if segments is None:
        return max(1, min(USUAL, (samples - 1) // FEWEST_SAMPLES))
    number = checks.count("segments", segments, least=1)
    if number > samples - 1:
        raise ValueError(f"segments must be at most the intervals between the times, {samples - 1}, got {number}")
    return number


def _noise(t: np.ndarray, x: np.ndarray, filled: np.ndarray, sigma: Any) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of the noise and of the motion, of each number."""
    size = np.std(filled, axis=0)
    size = np.where(size > 0, size, 1.0)
    if sigma is None:
        one = np.ones((len(t), 1))
        noise = np.array([noise_of(t, column[:, None], one) or 0.0 for column in x.T])
        return np.maximum(noise, 1e-6 * size), size
    noise = checks.reals("sigma", sigma, "a number or one a number of the state")
    if noise.shape not in ((), size.shape) or not (noise > 0).all():
        raise ValueError(f"sigma must be above 0, one number or of shape {size.shape}, got {checks.shown(sigma)}")
    return np.broadcast_to(noise, size.shape), size


def _filled(t: np.ndarray, x: np.ndarray, guess: Any) -> np.ndarray:
    """Values with gaps filled by the guess, or by their neighbours in time."""
    if guess is not None:
        other = checks.reals("guess", guess, "numbers of shape (time, number)")
        if other.shape != x.shape:
            raise ValueError(f"guess must have shape {x.shape}, as values, got {other.shape}")
        x = np.where(np.isfinite(x), x, other)
    columns = []
    for k, column in enumerate(x.T):
        seen = np.isfinite(column)
        if not seen.any():
            raise ValueError(f"values must show each number at some times, got only NaN in column {k}; give a guess=")
        columns.append(np.interp(t, t[seen], column[seen]))
    return np.stack(columns, axis=1)
