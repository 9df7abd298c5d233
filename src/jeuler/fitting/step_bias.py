"""How far the integrator's own error moves what a fit found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jeuler.fitting import least_squares
from jeuler.fitting.beside import attached
from jeuler.fitting.factors import projected
from jeuler.fitting.forward import Forward
from jeuler.fitting.least_squares import State
from jeuler.fitting.prediction import recording
from jeuler.fitting.report import INVERSE
from jeuler.fitting.result import Fit
from jeuler.fitting.unknowns import Layout, readable

if TYPE_CHECKING:
    from jeuler.fitting.recorded import Recorded

TENTH = 0.1  # of a standard error: the least that is worth a word
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
        return None, [f"at dt = {dt / 2:g} the run is not finite, so the bias of the step is not known"]
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
    advised = dt * min((TENTH / share[worst]) ** (1 / order), 0.5)
    exponent = np.floor(np.log10(advised))
    advised = np.floor(advised / 10 ** (exponent - 1)) * 10 ** (exponent - 1)
    return bias, [
        f"the integrator's error at dt = {dt:g} moves {layout.names(readable)[worst]} by {shift[worst]:.2g}, "
        f"{share[worst]:.2g} standard errors (.step_bias): use dt = {advised:.2g}"
    ]


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
