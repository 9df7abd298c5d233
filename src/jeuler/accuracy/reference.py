"""What errors are measured against: an exact solution, a given one, or an accurate solver; always in float64."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks, trees
from jeuler._core.component import Function
from jeuler._core.precision import double_precision, flat, flat_rows
from jeuler._jax import programs
from jeuler.steps.explicit import VectorField

PyTree = Any
TOLERANCES = 1e-11, 1e-13  # relative and, times the size of y0, absolute; the second is the reference


class Norm:
    """A norm of the user's own, of a state or a difference of states given as its numbers."""

    def __init__(self, norm: Callable[[PyTree], Any], y0: PyTree) -> None:
        self.norm: Callable[[PyTree], Any] = norm
        self.unflatten: Callable[[Any], PyTree]
        vector, self.unflatten = trees.real_vector(y0)
        checks.function("norm", norm, "(y) -> a number", "it is called with a difference of states, of the form of y0")
        self(np.asarray(vector))

    def __call__(self, numbers: np.ndarray) -> float:
        with double_precision():
            size = np.asarray(self.norm(self.unflatten(jnp.asarray(numbers))))
        if size.shape or size.dtype.kind not in "iuf" or size < 0:
            raise ValueError(f"norm must return one number that is at least 0, got {checks.shown(size)}")
        return float(size)


@dataclasses.dataclass(frozen=True)
class Reference:
    """States to compare with.

    Attributes:
      times: (time,), s, rising.
      states: (time, number), the numbers of y in one row each; NaN where nothing is known.
      error: how far the states may be trusted: the norm of the last one's change from the looser tolerance; 0.0 for an
        exact or a given reference.
    """

    times: np.ndarray
    states: np.ndarray
    error: float

    def at(self, times: np.ndarray) -> np.ndarray:
        return self.states[np.searchsorted(self.times, times, side="right") - 1]


def distinct(times: np.ndarray, t0: float, t1: float) -> np.ndarray:
    """The times, sorted, those that are the same but for roundoff once: the least of them."""
    same = 1e-12 * (t1 - t0) + 8 * np.finfo(float).eps * max(abs(t0), abs(t1))
    kept = [-np.inf]
    for t in np.unique(times).tolist():
        if t - kept[-1] > same:
            kept.append(t)
    return np.array(kept[1:])


def make_reference(
    reference: Any, f: VectorField, y0: PyTree, args: PyTree, times: np.ndarray, norm: Norm | None = None
) -> Reference:
    """The reference at sorted times; y0 and args in float64.

    reference: a function of t, the state at the last time, a diffrax solver, or None for ``diffrax.Dopri8``.
    """
    import diffrax

    size = norm or np.linalg.norm
    if reference is None or isinstance(reference, diffrax.AbstractSolver):
        solver = diffrax.Dopri8() if reference is None else reference
        inputs, settings = (Function(f), y0, args, _size(y0)), (tuple(times.tolist()), solver)
        loose, tight = (flat_rows(programs.call(accurate, (*inputs, rtol), settings)) for rtol in TOLERANCES)
        if not np.all(np.isfinite(tight)):
            raise ValueError(
                f"reference must be finite, got NaN or inf from {type(solver).__name__} at tolerance "
                f"{TOLERANCES[1]}; give an exact solution as a function of t, or a stiff solver such as "
                "diffrax.Kvaerno5()"
            )
        return Reference(times, tight, float(size(tight[-1] - loose[-1])))
    if callable(reference):
        states = np.stack([flat(reference(t)) for t in times])
    else:
        final = flat(reference)
        states = np.full((len(times), final.size), np.nan)
        states[0], states[-1] = flat(y0) if final.size == flat(y0).size else np.nan, final
    if states.shape[1] != flat(y0).size:
        raise ValueError(
            f"reference must have the numbers of y0, {flat(y0).size}, got {states.shape[1]}; give a function "
            f"of t that returns a state, or the state at t1"
        )
    return Reference(times, states, 0.0)


def _size(y0: PyTree) -> float:
    """What atol is measured by."""
    return max(float(np.linalg.norm(flat(y0))), 1e-3)


def accurate(
    f: VectorField, y0: PyTree, args: PyTree, size: Any, rtol: Any, times: tuple[float, ...], solver: Any
) -> PyTree:
    """States at the times by an adaptive diffrax solver that steps exactly to each of them. Differentiable."""
    import diffrax

    control = diffrax.PIDController(rtol=rtol, atol=rtol * size)
    if len(times) > 2:
        control = diffrax.ClipStepSizeController(control, step_ts=jnp.asarray(times))
    return diffrax.diffeqsolve(
        diffrax.ODETerm(f),
        solver,
        times[0],
        times[-1],
        None,
        y0,
        args,
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=control,
        max_steps=1_000_000,
        throw=False,
    ).ys


@dataclasses.dataclass(frozen=True)
class ReferenceGradient:
    """The derivative of a scalar of the final state with respect to args, as one vector, and its trust."""

    value: np.ndarray
    error: float


def make_reference_gradient(
    scalar: Callable[..., Any], reference: Any, f: VectorField, y0: PyTree, args: PyTree, t0: float, t1: float
) -> ReferenceGradient:
    """By reverse mode through the accurate solver at two tolerances."""
    import diffrax

    solver = reference if isinstance(reference, diffrax.AbstractSolver) else diffrax.Dopri8()

    def final(args, tolerance):
        states = accurate(f, y0, args, _size(y0), tolerance, (t0, t1), solver)
        return scalar(jax.tree.map(lambda leaf: leaf[-1], states))

    gradient = jax.jit(jax.grad(final))
    loose, tight = (flat(gradient(args, tolerance)) for tolerance in TOLERANCES)
    return ReferenceGradient(tight, float(np.linalg.norm(tight - loose)))


def error_norms(
    states: np.ndarray, reference: np.ndarray, times: np.ndarray, norm: Norm | None = None
) -> dict[str, float]:
    """Norms of the error, over all numbers of the state where none is given: at the end, largest, and rms in time."""
    error, size = (
        np.linalg.norm(rows, axis=1) if norm is None else np.array([norm(row) for row in rows])
        for rows in (states - reference, reference)
    )
    spans = np.diff(times)
    weights = (np.append(spans, 0) + np.append(0, spans)) / 2  # the trapezoidal rule
    mean_square = lambda x: float(np.sqrt(np.sum(weights * x**2) / np.sum(weights)))  # noqa: E731
    absolute = {"final": float(error[-1]), "max": float(error.max()), "l2": mean_square(error)}
    scale = {"final": float(size[-1]), "max": float(size.max()), "l2": mean_square(size)}
    norms = {f"error_{name}": value for name, value in absolute.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        norms |= {f"error_{name}_relative": float(np.divide(absolute[name], scale[name])) for name in absolute}
    return norms
