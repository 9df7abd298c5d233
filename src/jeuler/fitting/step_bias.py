"""How far the integrator's own error moves what a fit found."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.asked import Asked
from jeuler.fitting.beside import attached
from jeuler.fitting.factors import projected
from jeuler.fitting.forward import Forward
from jeuler.fitting.least_squares import State
from jeuler.fitting.matrix_free import ACCURACY, products
from jeuler.fitting.prediction import compiled_positions, recording
from jeuler.fitting.problem import variance_of_noise
from jeuler.fitting.report import INVERSE
from jeuler.fitting.result import Fit
from jeuler.fitting.unknowns import Layout

if TYPE_CHECKING:
    from jeuler.fitting.recorded import Recorded

TENTH = 0.1  # of a standard error: the least that is worth a word
UNKNOWN = "the bias of the step is not computed for so many unknowns here: fit once more at half the dt and compare"
NOT_FINITE_IN_HALVES = "at dt = {:g} the run is not finite, so the bias of the step is not known"
RANDOM = "the run draws random numbers in each step, so the bias of the step is not known"


def bias_of_step(task: Recorded, found: Fit, state: State) -> tuple[Any, list[str]]:
    """The shift of each parameter by the integrator's error, and what is to be said about it.

        shift = J^+ (r(0) - r(dt)),   r(0) = r(dt) + (r(dt / 2) - r(dt)) 2^q / (2^q - 1)

    Args:
      task: the recording with the scene.
      found, state: the fit at dt, and where its search ended.
    Returns: fitted minus what an exact integrator would give, of the structure of the params; and sentences.
    Source: the extrapolation of L. F. Richardson; the projection is the Gauss-Newton step.
    """
    whole, half = _residuals(task, Layout.of(found.params), found)
    return shifted(whole, half, task.dt, task.prediction.step, found, state)


def shifted(
    whole: np.ndarray, half: np.ndarray, dt: float, step: Any, found: Fit, state: State
) -> tuple[Any, list[str]]:
    """`bias_of_step` from the residuals in steps of dt and of dt / 2."""
    layout = Layout.of(found.params)
    if not np.isfinite(half).all():
        return None, [NOT_FINITE_IN_HALVES.format(dt / 2)]
    with np.errstate(all="ignore"):
        weights = np.where(whole != 0, state.residual[: len(whole)] / whole, 0)
    order = getattr(step, "order", 1)
    jump = 2**order / (2**order - 1)
    change = np.zeros(len(state.residual))  # that of the rows of priors is 0
    change[: len(whole)] = (half - whole) * jump * weights
    shift = _shift(state, change, attached(found, INVERSE))
    error = np.asarray(layout.vector(found.stderr), float)
    share = np.where(np.isfinite(error) & (error > 0), np.abs(shift) / np.where(error > 0, error, 1), 0)
    bias = layout.params(shift)
    worst = int(np.argmax(share)) if share.size else 0
    if not share.size or share[worst] <= TENTH:
        return bias, []
    return bias, [
        f"the integrator's error at dt = {dt:g} moves {layout.names()[worst]} by {shift[worst]:.2g}, "
        f"{share[worst]:.2g} standard errors (.step_bias): use dt = {_advised(dt, share[worst], order):.2g}"
    ]


def bias_of_many(task: Recorded, found: Fit, asked: Asked) -> tuple[Any, list[str]]:
    """`bias_of_step` without a Jacobian, by the damped step of the search: for so many unknowns that all errors lack.

        share = sqrt(|J shift|^2 / n) / sigma,   the root mean square of the shifts in standard errors

    over the directions that the data determine, for independent noise. One number may be moved by more of its own.
    """
    problem, step = asked.problem, task.prediction.step
    if problem.residual.priors is not None:
        return None, [UNKNOWN]
    steps = 2 * task.prediction.num_steps
    finer = dataclasses.replace(task.prediction, num_steps=steps)
    columns, observed = np.asarray(task.prediction.columns, int), np.asarray(task.data["observed"])
    how: dict[str, Any] = {"t0": task.t0, "num_steps": steps, "key": task.key}
    halved = recording(task.scene, task.state, task.times, task.targets, columns, dt=task.dt / 2, **how)
    runs = ((task.prediction, task.data), (finer, halved))
    whole, half = (np.asarray(compiled_positions(p)(found.params, data), float) for p, data in runs)
    whole, half = (run.reshape(len(run), -1)[:, columns] for run in (whole, half))
    if not np.isfinite(half[observed]).all():
        return None, [NOT_FINITE_IN_HALVES.format(task.dt / 2)]
    order = getattr(step, "order", 1)
    change = np.where(observed, (half - whole) * 2**order / (2**order - 1), 0)
    # measured so that the residual is the change, the step of the search is -J^+ of it: from fitted to exact
    as_if = asked.task._replace(data={**task.data, "targets": np.where(observed, whole - change, 0)})
    step_of, zero = products(problem.residual, asked.loss).step, np.asarray(0.0)
    shift, decrease, _ = step_of(asked.state.x, as_if, zero, np.asarray(ACCURACY), zero)
    variance = variance_of_noise(problem, asked.task, asked.state)
    share = float(np.sqrt(max(float(decrease), 0.0) / len(asked.state.x) / variance))
    bias = problem.layout.params(-np.asarray(shift, float))
    if not share > TENTH:
        return bias, []
    return bias, [
        f"the integrator's error at dt = {task.dt:g} moves the unknowns by {share:.2g} standard errors, root mean "
        f"square (.step_bias): use dt = {_advised(task.dt, share, order):.2g}"
    ]


def _advised(dt: float, share: float, order: int) -> float:
    """The dt at which the bias is well below a tenth of a standard error, rounded down to two digits.

    By its order it would be half of that there; a coarse dt does not show its order quite.
    """
    advised = dt * min((TENTH / 2 / share) ** (1 / order), 0.5)
    unit = 10 ** (np.floor(np.log10(advised)) - 1)
    return float(np.floor(advised / unit) * unit)


def _residuals(task: Recorded, layout: Layout, found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """The residuals in steps of dt and of dt / 2."""
    steps = task.prediction.num_steps * 2
    x, columns = np.asarray(layout.vector(found.params), float), task.prediction.columns
    halved = recording(
        task.scene,
        task.state,
        task.times,
        task.targets,
        columns,
        dt=task.dt / 2,
        t0=task.t0,
        num_steps=steps,
        key=task.key,
    )
    forward = Forward.of(task.prediction, layout, task.data)
    return forward.residual_at(x, task.data)[0], forward.residual_at(x, halved, parts=2)[0]


def _shift(state: State, change: np.ndarray, inverse: np.ndarray | None) -> np.ndarray:
    """J^+ of a change of the weighted residual: how far the minimum is from where it is with that change."""
    if inverse is not None:
        return np.asarray(inverse @ (state.jacobian.T @ change))
    scale = np.where(state.scale > 0, state.scale, 1)
    q, triangle = projected(state.jacobian / scale, change[:, None])
    return -least_squares.damped_solution(triangle, q[:, 0], np.asarray(0.0)) / scale
