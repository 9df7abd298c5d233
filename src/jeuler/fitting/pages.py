"""A fit as a page to hand over: what `SpringFit.report` writes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jeuler.fitting._tables import unit_of
from jeuler.fitting.beside import attached
from jeuler.fitting.unknowns import Layout
from jeuler.forces import Springs

if TYPE_CHECKING:
    from jeuler.fitting._springs import SpringFit
    from jeuler.fitting.measured.task import Several
    from jeuler.fitting.recorded import Recorded
    from jeuler.fitting.series import Series
    from jeuler.plotting.report import FitReport, Net, Parameter

RECORDING = "recording"  # under this name what was fitted is kept beside a `SpringFit`


def page_of(found: SpringFit) -> FitReport:
    """The page of a fit, with the recording that it was made from."""
    from jeuler.plotting.report import FitReport, Shown

    task: Recorded | Several | None = attached(found, RECORDING)
    if task is None or task.traced:
        raise ValueError(
            "a report needs the fit as `fit_springs` gave it, with its data: "
            "a copy, and what comes out of jit or vmap, has none; fit again"
        )
    kinds, rows = task.series(found.predicted), list(_rows(found))
    several = sum(len(kind.steps) for kind in kinds)
    times = sum(len(kind.times) - len(kind.steps) + 1 for kind in kinds)
    return FitReport(
        title=f"Fit of {len(rows)} parameter{'s' * (len(rows) > 1)} to {times} times"
        + f" of {several} recordings" * (several > 1),
        verdict=found.message[:1].upper() + found.message[1:] + ".",
        shown=[
            Shown(
                kind.times, kind.observed, kind.predicted, kind.names, kind.unit, kind.quantity, _whose(kind, several)
            )
            for kind in kinds
        ],
        parameters=rows,
        facts=list(_facts(found, kinds, task.dt)),
        next_steps=list(next_steps(found)),
        correlation=None if found.covariance is None else ([row.name for row in rows], found.correlation),
        history=found.history,
        net=_net(found),
    )


def _rows(found: SpringFit) -> Iterator[Parameter]:
    """One row a number."""
    from jeuler.plotting.report import Parameter

    layout = Layout.of(found.params)
    values = np.asarray(layout.vector(found.params), float)
    errors = [None] * len(values) if found.stderr is None else np.asarray(layout.vector(found.stderr), float)
    bias = [None] * len(values) if found.step_bias is None else np.asarray(layout.vector(found.step_bias), float)
    bounded = set(found.at_bound)
    for name, value, error, shift in zip(layout.names(), values, errors, bias, strict=True):
        notes = ["ended on a bound"] if name in bounded else []
        if shift is not None and error and np.isfinite(error) and abs(shift) > 0.1 * error:
            notes.append(f"the step's own error moves it by {shift:.2g}")
        yield Parameter(name, value, error, unit_of(name, found.scene), "; ".join(notes))


def _whose(kind: Series, several: int) -> str:
    """Which recordings are shown, counted from 1; "" where there is only one."""
    if several == 1:
        return ""
    numbers = [str(k + 1) for k in kind.recordings]
    return f"recording{'s' * (len(numbers) > 1)} {', '.join(numbers[:8])}{' ...' * (len(numbers) > 8)}"


def _facts(found: SpringFit, kinds: Sequence[Series], dt: float) -> Iterator[tuple[str, str]]:
    """The summary."""
    for kind in kinds:
        what = f", {kind.quantity}" * (len(kinds) > 1)
        numbers = "coordinates" if kind.quantity == "position" else "values"
        span = f"{kind.times[0]:.5g} to {kind.times[-1]:.5g} s" + ", one after another" * (len(kind.steps) > 1)
        yield f"observed{what}", f"{kind.count} {numbers} from {span}"
        yield f"residual, RMS{what}", f"{kind.rms:.4g} {kind.unit}".rstrip()
    steps = [step for kind in kinds for step in kind.steps]
    yield "simulation", f"{', '.join(map(str, steps[:8]))}{' ...' * (len(steps) > 8)} steps of {dt:.4g} s"
    if found.held_out_rms is not None:
        unit = kinds[0].unit if len(kinds) == 1 else "in the units of the readings"
        yield "residual, RMS, of what was fitted", f"{found.training_rms:.4g} {unit}".rstrip()
        yield "residual, RMS, of what was held out", f"{found.held_out_rms:.4g} {unit}".rstrip()
    if found.explained is not None:
        yield "variance explained", f"{100 * found.explained:.5g} %"
    if found.noise_ratio is not None:
        yield "residual over the noise", f"{found.noise_ratio:.3g}"
    if found.autocorrelation is not None:
        yield "correlation, one sample to the next", f"{found.autocorrelation:.2f}"
    yield "iterations", str(len(found.history))
    if found.blind:
        yield "not determined by the data", "; ".join(found.blind)


def next_steps(found: SpringFit) -> Iterator[str]:
    """What to do now, by what the fit says of itself."""
    if not found.converged:
        yield "The search did not converge: allow more iterations, or start nearer, before any number is used."
    if found.blind:
        yield (
            "What the data do not determine must be measured otherwise: hold one of the parameters that it names at a "
            "known value, or record a motion in which they differ."
        )
    if found.at_bound:
        yield "A parameter on its bound has no error of its own: leave it out of the fit, or question the model."
    if found.noise_ratio is not None and found.noise_ratio > 1.5:
        yield (
            "The residual is larger than the noise: look at its pattern above, add the force that is missing (drag, "
            "friction, a cubic spring), or start the search elsewhere with starts=64."
        )
    elif found.autocorrelation is not None and found.autocorrelation > 0.3:
        yield "The residual has a pattern: a line in its spectrum is a motion that the model does not have."
    if "use dt" in found.message:
        yield "The step of the simulation is felt in the numbers: fit again with the smaller dt named above."
    if found.stderr is None:
        yield "There are too many unknowns for all errors: found.standard_error(name) gives those that you ask for."
    yield "Test the parameters on a recording that was not fitted: the residual there is the one that counts."


def _net(found: SpringFit) -> Net | None:
    """The springs of the scene, at the first positions."""
    from jeuler.plotting.report import Net

    springs = [force for force in found.scene.forces if isinstance(force, Springs) and len(force.edges)]
    if not springs:
        return None

    def each(field: str) -> np.ndarray:
        return np.concatenate([np.broadcast_to(np.asarray(getattr(s.at(0.0), field)), len(s.edges)) for s in springs])

    edges: Any = np.concatenate([np.asarray(s.edges) for s in springs])
    state = found.state[0] if isinstance(found.state, tuple) else found.state
    pinned = np.isinf(np.broadcast_to(np.asarray(state.mass), len(state.position)))
    values = {"ks [N/m]": each("ks"), "kd [N s/m]": each("kd")}
    return Net(np.asarray(state.position), edges, values, pinned)
