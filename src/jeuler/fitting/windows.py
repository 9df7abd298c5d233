"""Windows of time of a recording, each run by itself from the tracks at its start: for descents by minibatches."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.component import replace
from jeuler._core.interpolate import hermite
from jeuler.fitting.observations import place_in_steps
from jeuler.fitting.prediction import Prediction
from jeuler.fitting.problem import Problem
from jeuler.fitting.smooth import FEWEST, Tracks, smoothed
from jeuler.fitting.weak_form import with_pinned

SHARE, FEW = 16, 4  # a window is a sixteenth of the record, and at least four samples


@dataclasses.dataclass(frozen=True, eq=False)
class InWindows:
    """Prediction minus measurement in each window, (window, sample, column), m.

    Attributes:
      prediction: of one window.
      shared: the data that all windows have alike.
    """

    prediction: Prediction
    shared: dict[str, Any]

    def __call__(self, params: dict[str, Any], windows: dict[str, Any]) -> Array:
        free = np.asarray(self.prediction.places.free, int)
        state = self.shared["state"]

        def one(window: dict[str, Any]) -> Array:
            begun = {name: getattr(state, name).at[free].set(window[name]) for name in ("position", "velocity")}
            return self.prediction(params, {**self.shared, **window, "state": replace(state, **begun)})

        return jax.vmap(one)(windows)


def in_windows(whole: Problem, task: Any, samples: int | None) -> Problem:
    """The problem of a `Recorded` in windows of so many samples, or one ValueError."""
    _check(whole, task)
    count = len(task.times)
    samples = max(FEW, -(-count // SHARE)) if samples is None else samples
    if not 2 <= samples <= count:
        raise ValueError(f"window must be from 2 to the {count} samples of the record, got {samples}")
    tracks = smoothed(task.times, task.targets)
    if tracks is None:
        raise ValueError(f"minibatch needs at least {FEWEST} samples of each particle; fit all at once, without it")
    tracks = with_pinned(tracks, task.state, task.prediction.places)
    first = np.append(np.arange(0, count - samples, samples - 1), count - samples)
    position, velocity, known = _at(tracks, task.times[first], task.prediction.places.free)
    spans = task.times[first + samples - 1] - task.times[first]
    first, position, velocity, spans = (a[known & (spans > 0)] for a in (first, position, velocity, spans))
    if not len(first):
        raise ValueError(
            "minibatch runs each window from the positions of all free particles at its start, got no window where all "
            "were observed; fit all at once, without it"
        )
    rows, steps = first[:, None] + np.arange(samples), max(1, int(np.ceil(spans.max() / task.dt * (1 - 1e-12))))
    starts, dtype, data = task.times[first], task.state.position.dtype, task.data
    placed = [place_in_steps(task.times[row], start, task.dt, steps) for row, start in zip(rows, starts, strict=True)]
    windows = {
        "position": position.astype(dtype),
        "velocity": velocity.astype(dtype),
        "t0": np.asarray(starts, float),
        "interval": np.stack([interval for interval, _ in placed]),
        "fraction": np.stack([fraction for _, fraction in placed]),
        "targets": data["targets"][rows],
        "observed": data["observed"][rows],
    }
    shared = {name: data[name] for name in ("scene", "state", "dt", "key")}
    residual = InWindows(dataclasses.replace(task.prediction, num_steps=steps), shared)
    found = Problem.of(residual, whole.layout.params(jnp.asarray(whole.x)), data=windows)
    weights = np.asarray(whole.weights).reshape(count, -1)[rows]
    return dataclasses.replace(found, weights=weights.ravel())


def _check(whole: Problem, task: Any) -> None:
    """One ValueError where windows cannot be run by themselves."""
    if whole.residual.priors is not None:
        raise ValueError("minibatch goes without priors and smoothness; leave these out, or fit all data at once")
    if task.traced:
        raise ValueError("minibatch needs values, got traced ones; fit all data at once under jit and vmap")
    names: Sequence[str] = [n for n in task.prediction.places.names if n in ("velocity", "position")]
    if names:
        raise ValueError(
            f"minibatch takes the start of each window from the data, so {names[0]!r} cannot be among parameters; "
            f"fit it with all data at once"
        )
    if task.state.alive is not None:
        raise ValueError("minibatch needs particles that all live, got a pool; fit all data at once, without it")


def _at(tracks: Tracks, times: np.ndarray, free: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and velocities of the free particles at these times, and whether all of them are known there."""
    step = tracks.times[1] - tracks.times[0]
    k = np.clip(np.searchsorted(tracks.times, times, side="right") - 1, 0, len(tracks.times) - 2)
    s = ((times - tracks.times[k]) / step)[:, None, None]
    x, v = (a[:, list(free)] for a in (tracks.position, tracks.velocity))
    known = (tracks.known[k] & tracks.known[k + 1])[:, list(free)].all(axis=1)
    ends: Any = (x[k], x[k + 1], v[k], v[k + 1])
    return np.asarray(hermite(s, step, *ends)), (1 - s) * v[k] + s * v[k + 1], known
