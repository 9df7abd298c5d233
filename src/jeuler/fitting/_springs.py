"""``fit_springs``: stiffness, damping and what else a scene holds, from measured positions."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.component import result
from jeuler._core.interpolate import hermite
from jeuler.fitting._fit import fit
from jeuler.fitting._tables import fit_table
from jeuler.fitting.observations import amplitude_of, checked_observations, horizons, place_in_steps, speed_of
from jeuler.fitting.parameters import is_positive, put_parameters, read_parameters, values_in_forces
from jeuler.particles._simulate import simulate
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import Step, rk4_step

PyTree = Any


@result
class SpringFit:
    """What `fit_springs` found.

    Attributes:
      ks, kd: stiffness (N/m) and damping (N s/m) of the fitted scene's `Springs`, fitted or not; a tuple of them where
        the scene has several.
      scene, state: the scene and the initial state with the fitted parameters put in.
      params: the fitted parameters by name.
      loss: mean square of position residuals, m^2.
      history: the loss after each iteration, m^2.
      stderr: standard errors by name, of the structure of params; inf where the data do not determine one.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree(params)``.
      predicted: positions at the given times, (time, particle, dim), m.
      converged, message, undetermined, nonfinite: as in `Fit`.
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

    ks: Any
    kd: Any
    scene: Scene
    state: ParticleState
    params: dict[str, Any]
    loss: float
    history: np.ndarray
    stderr: Any
    covariance: np.ndarray | None
    predicted: Array
    converged: bool
    message: str
    undetermined: tuple[str, ...]
    nonfinite: int

    _repr_html_ = fit_table


def fit_springs(
    scene: Scene,
    state: ParticleState,
    times: Any,
    positions: Any,
    *,
    dt: float,
    parameters: tuple[str, ...] = ("ks", "kd"),
    t0: float = 0.0,
    num_steps: int | None = None,
    step: Step = rk4_step,
    optimizer: Any = None,
    max_iterations: int = 200,
    tolerance: float = 1e-6,
    grow: bool = True,
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
      parameters: what is free: any of "ks", "kd", "rest_length" (or another parameter of the scene's forces, such as
        "coefficient" of a drag; "forces[1].ks" names that of one force among several), "mass" (of the particles that
        can move), "velocity", "position" (their initial ones) and "anchors" (positions of the pinned particles).
        Force parameters and masses are fitted as logarithms, so they stay positive; vectors, such as gravity's
        "acceleration", are fitted as they are.
      t0: time of the state, s.
      num_steps: number of steps; None takes as many as reach the last time.
      step: the method, as in `solve`.
      optimizer: None for Levenberg-Marquardt, or any optax optimiser, as in `fit`.
      max_iterations: the most iterations in each stage.
      tolerance: stop when the loss decreases by less than this share.
      grow: fit the first sixteenth of the time span first, then twice as much and so on: what keeps an oscillation's
        fit out of wrong periods. False fits all of it at once.
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
    state.check()
    scene.check(state)
    checks.positive("dt", dt, "s")
    checks.number("t0", t0)
    times, targets = checked_observations(times, positions, state.position.shape, float(t0))
    needed = max(1, int(np.ceil((times[-1] - t0) / dt * (1 - 1e-12))))
    num_steps = needed if num_steps is None else checks.count("num_steps", num_steps, least=1)
    if num_steps < needed:
        raise ValueError(
            f"times must lie in the simulated span, {t0} to {t0 + num_steps * dt} s, got {times[-1]}; "
            f"num_steps={needed} reaches it"
        )
    observed = np.nonzero(np.isfinite(targets))
    observed_targets = targets[observed]
    interval, s = place_in_steps(times, t0, dt, num_steps)
    start = read_parameters(scene, state, parameters)
    amplitude = amplitude_of(targets)

    def predict(params: dict[str, Any]) -> Array:
        fitted_scene, fitted_state = put_parameters(scene, state, params)
        run = simulate(
            fitted_scene,
            fitted_state,
            dt=dt,
            num_steps=num_steps,
            t0=t0,
            step=step,
            save=lambda t, now: (now.position, now.velocity),
        )
        p, v = run.y
        fraction = jnp.asarray(s, p.dtype)[:, None, None]
        return hermite(fraction, jnp.asarray(dt, p.dtype), p[interval], p[interval + 1], v[interval], v[interval + 1])

    def residual(params: dict[str, Any]) -> Array:
        predicted = predict(params)
        return predicted[observed] - jnp.asarray(observed_targets, predicted.dtype)

    stages = horizons(times[observed[0]] - t0) if grow else ()
    result = fit(
        residual,
        start,
        positive={name: is_positive(name) for name in start},
        scale={name: speed_of(times, targets) if name == "velocity" else amplitude for name in start},
        optimizer=optimizer,
        max_iterations=max_iterations,
        tolerance=tolerance,
        stages=stages,
        progress=progress,
    )
    fitted_scene, fitted_state = put_parameters(scene, state, result.params)
    return SpringFit(
        ks=values_in_forces(fitted_scene, "ks"),
        kd=values_in_forces(fitted_scene, "kd"),
        scene=fitted_scene,
        state=fitted_state,
        predicted=jax.jit(predict)(result.params),
        **{field.name: getattr(result, field.name) for field in dataclasses.fields(result)},
    )
