"""``fit_springs``: stiffness, damping and what else a scene holds, from measured positions."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import Any

from jax import Array

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting.beside import attach, attached
from jeuler.fitting.options import Options
from jeuler.fitting.pages import RECORDING, page_of
from jeuler.fitting.parameters import values_of_springs
from jeuler.fitting.profiles import AGAIN
from jeuler.fitting.recorded import Recorded
from jeuler.fitting.result import Fit, as_pytree
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import Step, rk4_step

PyTree = Any


@result
class SpringFit(Fit):
    """What `fit_springs` found: a `Fit`, with the scene that it belongs to.

    Attributes:
      ks, kd: stiffness (N/m) and damping (N s/m) of the fitted scene's `Springs`, fitted or not; where the scene has
        several, one array with one value a spring.
      scene, state: the scene and the initial state with the fitted parameters put in.
      params: the fitted parameters by name.
      loss: mean square of position residuals, m^2; over sigma^2 where sigma is given.
      history: the loss after each iteration.
      stderr: standard errors by name, of the structure of params, for noise that is correlated as the residual is; inf
        where the data do not determine one. ``stderr_white``: the same for independent noise.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree(params)``.
      predicted: positions at the given times, (time, particle, dim), m.
      step_bias: how far the integrator's own error moves each parameter, of the structure of params: fitted minus what
        an exact integrator would give. None where it was not asked for.
      start: where the search began: "data" (from the positions alone) or "given" (the scene's values).
      explained: share of the variance of the positions that the fit explains.
      noise_ratio: residual over the noise seen in the data, or over sigma; 1 where nothing is left to explain.
      converged, message, undetermined, blind, at_bound, autocorrelation, residual, nonfinite, starts: as in `Fit`.
    Example:
      >>> import jax.numpy as jnp, numpy as np, jeuler
      >>> weight = jeuler.ParticleState([[0.0], [1.2]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
      >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=25.0, kd=0.0, rest_length=1.0),))
      >>> times = np.linspace(0.0, 2.0, 41)
      >>> swinging = 1 + 0.2 * np.cos(np.sqrt(30.0) * times)  # of ks = 30 N/m
      >>> positions = np.stack([0 * times, swinging], 1)[..., None]
      >>> found = jeuler.fit_springs(scene, weight, times, positions, dt=0.01, parameters=("ks",))
      >>> round(float(found.ks), 1), found.converged, found.predicted.shape
      (30.0, True, (41, 2, 1))
    """

    _: dataclasses.KW_ONLY
    ks: Any
    kd: Any
    scene: Scene
    state: ParticleState
    predicted: Array
    step_bias: Any = None
    start: str = "given"

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the fit as one HTML file, which a browser opens without a network.

        It shows data over prediction, the residual with its autocorrelation and spectrum, each parameter with its
        95 % interval, the correlation of their errors, the net coloured by ks and kd, the loss, what the data do not
        determine, and what to do next. What stood at the path is replaced when the page is whole.

        Args:
          path: where it goes.
        Raises: ValueError, if the fit was copied, or made under jit or vmap: it does not have its data then.
        Example:
          >>> import os, tempfile, jax.numpy as jnp, numpy as np, jeuler
          >>> weight = jeuler.ParticleState([[0.0], [1.2]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
          >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=25.0, kd=0.0, rest_length=1.0),))
          >>> times = np.linspace(0.0, 2.0, 41)
          >>> positions = np.stack([0 * times, 1 + 0.2 * np.cos(np.sqrt(30.0) * times)], 1)[..., None]
          >>> found = jeuler.fit_springs(scene, weight, times, positions, dt=0.01, parameters=("ks",))
          >>> with tempfile.TemporaryDirectory() as folder:
          ...     found.report(os.path.join(folder, "fit.html"))
          ...     os.listdir(folder)
          ['fit.html']
        """
        page_of(self).write(path)


as_pytree(SpringFit, ("message", "undetermined", "blind", "at_bound", "start"))


@says_what_to_write()
def fit_springs(
    scene: Scene,
    state: ParticleState,
    times: Any,
    positions: Any,
    *,
    dt: float,
    parameters: tuple[str, ...] = ("ks", "kd"),
    where: Callable[[Scene], Any] | None = None,
    bounds: dict[str, Any] | None = None,
    sigma: Any = None,
    weights: Any = None,
    priors: dict[str, Any] | None = None,
    loss: str = "linear",
    loss_scale: float | None = None,
    start: str = "data",
    starts: Any = None,
    t0: float = 0.0,
    num_steps: int | None = None,
    step: Step = rk4_step,
    optimizer: Any = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    grow: bool = True,
    step_bias: bool = True,
    resume: Any = None,
    progress: bool | None = None,
) -> SpringFit:
    """Fit a scene's parameters to measured positions by gradient through the simulation.

        minimise  loss = mean over observed k of |p(t_k) - target_k|^2 / dim

    The simulation is read between its steps by cubic Hermite interpolation of position and velocity. The default step
    is `rk4_step`: a first-order step's own damping (of -omega^2 dt / 2 for explicit Euler) would end up in kd.

    Args:
      scene: forces and effects, with the starting values of what is fitted.
      state: the state at t0, with the starting values of what is fitted; mass = inf marks the anchors.
      times: when the positions were measured, (time,), s; not decreasing, on any grid, from t0 on.
      positions: what was measured, (time, particle, dim), m; NaN = not observed.
      dt: step size of the simulation, s.
      parameters: what is free: any of "ks", "kd", "rest_length" (of the scene's springs, or another parameter of its
        forces, such as "coefficient" of a drag; "forces[1].ks" names that of one force), "mass" (of the particles that
        can move), "velocity", "position" (their initial ones) and "anchors" (positions of the pinned particles).
        What cannot be negative by its meaning is fitted from 0 on, 0 included.
      where: a function of the scene that picks further arrays to fit, such as ``lambda scene: scene.forces[1].ks``;
        they are ``params["where"]``.
      bounds: ``{name: (lower, upper)}`` for any of the parameters; None or inf leaves a side open.
      sigma: the known error of the positions, m, broadcast to (time, particle, dim); errors are then not scaled by the
        residual.
      weights: relative weights instead, broadcast to (time, particle, dim).
      priors: ``{name: (mean, sigma)}`` of parameters, known beforehand, as in `fit`; they need ``sigma``.
      loss, loss_scale: "linear", or "soft_l1" or "huber" for outliers, as in `fit`.
      start: "data" finds ks, kd and what else enters the forces linearly from the positions alone, by the weak form of
        the equation of motion, and starts there; "given" starts from the scene's values. Where the first does not lead
        to a good fit, the second is tried too, and the better is kept.
      starts: search from this many starts about that one, in one batched program, as in `fit`.
      t0: time of the state, s.
      num_steps: number of steps; None takes as many as reach the last time.
      step: the method, as in `solve`.
      optimizer: None for Levenberg-Marquardt, or any optax optimiser, as in `fit`.
      max_iterations: the most iterations in each stage.
      tolerance: how near the minimum must be, in standard errors, by the linear model, as in `fit`.
      grow: from given values, fit the first sixteenth of the time span first, then twice as much and so on: what keeps
        an oscillation's fit out of wrong periods. False fits all of it at once.
      step_bias: solve once more at dt / 2 and report how far the integrator's error moves each parameter.
      resume: path of a file in which the search writes where it is, and from which it goes on, as in `fit`.
      progress: show a progress bar; None shows it on a terminal.
    Returns: `SpringFit`.
    Raises: ValueError, before tracing, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> def scene(ks, kd):
      ...     return jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks=ks, kd=kd, rest_length=1.0),))
      >>> state = jeuler.ParticleState([[0.0], [1.5]], [[0.0], [0.0]], mass=[jnp.inf, 1.0])
      >>> t = jnp.linspace(0.0, 3.0, 61)
      >>> x = 1 + 0.5 * jnp.exp(-0.25 * t) * (jnp.cos(3 * t) + 0.25 / 3 * jnp.sin(3 * t))  # exact
      >>> target = jnp.stack([0 * t, x], axis=1)[:, :, None]
      >>> found = jeuler.fit_springs(scene(4.0, 0.2), state, t, target, dt=0.05)
      >>> round(float(found.ks), 2), round(float(found.kd), 2)  # 3^2 + 0.25^2 and 2 * 0.25
      (9.06, 0.5)

    Source: the source's springs and dampers; K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least
      Squares Problems, 2004.
    """
    options = Options(
        loss=loss,
        loss_scale=loss_scale,
        starts=starts,
        optimizer=optimizer,
        max_iterations=max_iterations,
        tolerance=tolerance,
        resume=resume,
        progress=progress,
    )
    checks.true_or_false("grow", grow)
    checks.true_or_false("step_bias", step_bias)
    if start not in ("data", "given"):
        raise ValueError(f'start must be "data" (from the positions) or "given" (the scene\'s values), got {start!r}')
    task = Recorded.of(
        scene, state, times, positions, dt=dt, t0=t0, num_steps=num_steps, step=step, names=parameters, where=where
    )
    found, begun = task.fit(options, bounds, sigma, weights, start, grow, priors)
    fields, bias, fitted_scene, fitted_state, predicted = task.completed(found, step_bias)
    complete = SpringFit(
        ks=values_of_springs(fitted_scene, "ks"),
        kd=values_of_springs(fitted_scene, "kd"),
        scene=fitted_scene,
        state=fitted_state,
        predicted=predicted,
        step_bias=bias,
        start=begun,
        **fields,
    )
    attach(complete, AGAIN, attached(found.fit, AGAIN))
    attach(complete, RECORDING, task)
    return complete
