"""``fit_springs``: stiffness, damping and what else a scene holds, from measured positions."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting.asked import ASKED
from jeuler.fitting.beside import attach, attached
from jeuler.fitting.errors import BLIND
from jeuler.fitting.held_out import judged, recordings_without
from jeuler.fitting.measured.readings import SENSOR_PARAMETERS
from jeuler.fitting.measured.recording import Recording, listed
from jeuler.fitting.measured.task import Several
from jeuler.fitting.options import Options
from jeuler.fitting.pages import RECORDING, page_of
from jeuler.fitting.parameters import values_of_springs
from jeuler.fitting.profiles import AGAIN
from jeuler.fitting.recorded import Recorded
from jeuler.fitting.result import DENSITY, Fit, as_pytree
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.solving.grid import Checkpoint
from jeuler.steps.explicit import Step, rk4_step

PyTree = Any


@result
class SpringFit(Fit):
    """What `fit_springs` found: a `Fit`, with the scene that it belongs to.

    Attributes:
      ks, kd: stiffness (N/m) and damping (N s/m) of the fitted scene's `Springs`, fitted or not; where the scene has
        several, one array with one value a spring.
      scene, state: the scene and the initial state with the fitted parameters put in; of several recordings a tuple of
        states.
      params: the fitted parameters by name.
      loss: mean square of the residuals, m^2 for positions; over sigma^2 where sigma is given.
      history: the loss after each iteration.
      stderr: standard errors by name, of the structure of params, for noise that is correlated as the residual is; inf
        where the data do not determine one. ``stderr_white``: the same for independent noise.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree(params)``.
      predicted: positions at the given times, (time, particle, dim), m; with ``observe`` what that shows, (time, ...);
        of several recordings a tuple of them.
      step_bias: how far the integrator's own error moves each parameter, of the structure of params: fitted minus what
        an exact integrator would give. None where it was not asked for or cannot be had, which the message says. Above
        3,000 unknowns it is said where the root mean square of all shifts, in standard errors, is above a tenth;
        of one number compare it with ``standard_error(name)``.
      start: where the search began: "data" (from the positions alone) or "given" (the scene's values).
      training_rms, held_out_rms: root mean square of prediction minus measurement over the part that was fitted and
        over that which was held out; None where nothing was.
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
    state: Any
    predicted: Any
    step_bias: Any = None
    start: str = "given"
    training_rms: float | None = None
    held_out_rms: float | None = None

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
    times: Any = None,
    positions: Any = None,
    *,
    dt: float,
    observe: Any = "position",
    recordings: Sequence[Recording] | None = None,
    parameters: tuple[str, ...] = ("ks", "kd"),
    per_recording: tuple[str, ...] | None = None,
    where: Callable[[Scene], Any] | None = None,
    ties: dict[str, Any] | None = None,
    bounds: dict[str, Any] | None = None,
    sigma: Any = None,
    weights: Any = None,
    priors: dict[str, Any] | None = None,
    smoothness: dict[str, float] | None = None,
    held_out: Any = None,
    loss: str = "linear",
    loss_scale: float | None = None,
    start: str = "data",
    starts: Any = None,
    t0: float = 0.0,
    num_steps: int | None = None,
    step: Step = rk4_step,
    key: Any = None,
    checkpoint: Checkpoint = None,
    optimizer: Any = None,
    minibatch: int | None = None,
    window: int | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    grow: bool = True,
    step_bias: bool = True,
    resume: Any = None,
    progress: bool | None = None,
) -> SpringFit:
    """Fit a scene's parameters to what was measured, positions or else, by gradient through the simulation.

        minimise  loss = mean over observed k of |p(t_k) - target_k|^2 / dim

    The simulation is read between its steps by cubic Hermite interpolation of position and velocity. The default step
    is `rk4_step`: a first-order step's own damping (of -omega^2 dt / 2 for explicit Euler) would end up in kd.

    Args:
      scene: forces and effects, with the starting values of what is fitted.
      state: the state at t0, with the starting values of what is fitted; mass = inf marks the anchors.
      times: when the positions were measured, (time,), s; not decreasing, on any grid, from t0 on.
      positions: what was measured, (time, particle, dim), m, or with ``observe`` what that shows, (time, ...); NaN =
        not observed.
      dt: step size of the simulation, s.
      observe: what was measured: "position", "velocity", "acceleration" of all particles, one of `jeuler.observing`
        (an angle, a distance, the pull of a spring, a camera's picture), or any function of (scene, state) or
        (t, state) that returns one array. With ``Sensor(...)``, or a name of these in ``parameters``, it has a "delay",
        a "gain" and a "bias"; a delay is looked for from 0 to a tenth of the record unless ``bounds`` say otherwise,
        and what the largest would put before t0 is left out.
      recordings: several `Recording` in place of times and positions, of any lengths and rates, fitted together:
        each has its own initial positions, velocities and anchors where these are ``parameters``; all else is shared.
      parameters: what is free: any of "ks", "kd", "rest_length" (of the scene's springs, or another parameter of its
        forces, or of its effects, such as "coefficient" of a drag or "restitution" of collisions; "forces[1].ks" and
        "effects[0].restitution" name that of one), "mass" (of the particles that can move), "velocity", "position"
        (their initial ones) and "anchors" (positions of the pinned particles).
        What cannot be negative by its meaning is fitted from 0 on, 0 included.
      where: a function of the scene that picks further arrays to fit, such as ``lambda scene: scene.forces[1].ks``;
        they are ``params["where"]``.
      per_recording: with ``recordings``, the parameters of which each has its own value, along a leading axis.
      ties: ``{name: labels}``, a label for each number of a parameter: those with the same label are one unknown, and
        ``params[name]`` has one number for each label, in the order in which they first come.
      bounds: ``{name: (lower, upper)}`` for any of the parameters; None or inf leaves a side open.
      sigma: the known error of the positions, m, broadcast to (time, particle, dim); errors are then not scaled by the
        residual.
      weights: relative weights instead, broadcast to (time, particle, dim).
      priors: ``{name: (mean, sigma)}`` of parameters, known beforehand, as in `fit`; they need ``sigma``.
      smoothness: ``{name: sigma}`` of parameters with one number a spring: springs that share a particle differ by
        about sigma, a prior on each such difference, (parameter - its neighbour) / sigma. It needs ``sigma``.
      held_out: the part that is not fitted, to judge the fit by: a share of the span at its end, such as 0.3, or
        booleans (time,). ``training_rms`` and ``held_out_rms`` are the residuals of both parts.
      loss, loss_scale: "linear", or "soft_l1" or "huber" for outliers, as in `fit`.
      start: "data" finds ks, kd and what else enters the forces linearly from the positions alone, by the weak form of
        the equation of motion, and starts there; "given" starts from the scene's values. Where the first does not lead
        to a good fit, the second is tried too, and the better is kept.
      starts: search from this many starts about that one, in one batched program, as in `fit`.
      t0: time of the state, s.
      num_steps: number of steps; None takes as many as reach the last time.
      step: the method, as in `solve`.
      key: a ``jax.random.key`` for effects that draw random numbers, as in `simulate`: each run draws the same.
      checkpoint: memory of reverse mode, as in `solve`: a number of steps or "sqrt". Above 500 unknowns, and with an
        ``optimizer``, a fit differentiates in reverse. The file that a fit goes on from is ``resume``.
      optimizer: None for Levenberg-Marquardt, or any optax optimiser, as in `fit`.
      minibatch: for ``optimizer``: each of its steps looks at so many windows of the record, drawn anew in every pass
        over them. A window is run by itself from the smoothed positions and velocities at its start, so all free
        particles must be observed. The history, the best and the verdict are of the whole record, run from ``state``.
      window: samples in each of them, at least 2; None takes a sixteenth of the record, at least 4.
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

    Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems,
      2004.
    """
    how: dict[str, Any] = {"loss": loss, "loss_scale": loss_scale, "starts": starts, "resume": resume}
    how |= {"optimizer": optimizer, "minibatch": minibatch, "progress": progress}
    options = Options(**how, max_iterations=max_iterations, tolerance=tolerance)
    _check_choices(parameters, start, grow, step_bias)
    _check_run(key, checkpoint, minibatch, window)
    records = [Recording(times, positions)] if recordings is None else listed(recordings, times, positions)
    whole, held = [each.values for each in records], None
    if held_out is not None:
        records, held = recordings_without(held_out, records)
    of_scene: dict[str, Any] = {"dt": dt, "t0": t0, "step": step, "names": parameters, "where": where, "ties": ties}
    of_scene |= {"key": key, "checkpoint": checkpoint}
    if recordings is None and observe == "position" and not any(name in SENSOR_PARAMETERS for name in parameters):
        task = Recorded.of(scene, state, times, records[0].values, num_steps=num_steps, **of_scene)
        found, begun = task.fit(options, bounds, sigma, weights, start, grow, priors, smoothness, window)
        return _completed(task, found, begun, step_bias, whole[0], held)
    _refuse_what_is_for_positions(minibatch, num_steps)
    of_record = {"observe": observe, "bounds": bounds, "sigma": sigma, "weights": weights}
    of_record |= {"single": recordings is None, "per_recording": per_recording}
    several = Several.of(scene, state, records, **of_record, **of_scene)
    found, begun = several.fit(options, start, grow, priors, smoothness)
    return _completed(several, found, begun, step_bias, whole[0] if recordings is None else whole, held)


def _check_choices(parameters: Any, start: Any, grow: Any, step_bias: Any) -> None:
    checks.true_or_false("grow", grow)
    checks.true_or_false("step_bias", step_bias)
    if start not in ("data", "given"):
        raise ValueError(f'start must be "data" (from the positions) or "given" (the scene\'s values), got {start!r}')
    if isinstance(parameters, str) or not isinstance(parameters, Iterable):
        raise ValueError(f'parameters must be a tuple of names such as ("ks", "kd"), got {checks.shown(parameters)}')


def _check_run(key: Any, checkpoint: Any, minibatch: Any, window: Any) -> None:
    if window is not None:
        checks.count("window", window, least=2)
        if minibatch is None:
            raise ValueError("window is for minibatch; pass minibatch=8 and an optax optimizer too, or leave it out")
    checks.random_key(key)
    if checkpoint == "reversible":
        raise ValueError(
            'checkpoint must be a number of steps, "sqrt" or None for a fit, got "reversible": it also runs forwards '
            'with derivatives, which that cannot; pass checkpoint="sqrt"'
        )


def _refuse_what_is_for_positions(minibatch: Any, num_steps: Any) -> None:
    if minibatch is not None:
        raise ValueError("minibatch is for positions of one record; leave it out, or write the residual for jeuler.fit")
    if num_steps is not None:
        raise ValueError("num_steps is for positions alone; leave it out: the run reaches the last time")


def _completed(task: Recorded | Several, found: Any, begun: str, step_bias: bool, whole: Any, held: Any) -> SpringFit:
    """What is reported of a fit: with the step's bias, and the residual of the part that was held out."""
    fields, bias, fitted_scene, fitted_state, predicted = task.completed(found, step_bias)
    if held is not None and not task.traced:
        task = task.seen_whole(whole)
        fields |= judged(task.series_of_each(predicted), held, fields["message"])
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
    for name in (AGAIN, ASKED, BLIND, DENSITY):
        attach(complete, name, attached(found.fit, name))
    attach(complete, RECORDING, task)
    return complete
