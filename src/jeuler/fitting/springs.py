"""``fit_springs``: stiffness, damping and what else a scene holds, from measured positions."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler import _check, _tree
from jeuler._interpolate import hermite
from jeuler.fitting.fit import fit
from jeuler.methods import Step, rk4_step
from jeuler.particles import ParticleState, Scene, simulate

PyTree = Any
STATE_PARAMETERS = ("mass", "velocity", "position", "anchors")


@dataclasses.dataclass(frozen=True)
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
    _check.positive("dt", dt, "s")
    _check.number("t0", t0)
    times, targets = _observations(times, positions, state.position.shape, float(t0))
    needed = max(1, int(np.ceil((times[-1] - t0) / dt * (1 - 1e-12))))
    num_steps = needed if num_steps is None else _check.count("num_steps", num_steps, least=1)
    if num_steps < needed:
        raise ValueError(
            f"times must lie in the simulated span, {t0} to {t0 + num_steps * dt} s, got {times[-1]}; "
            f"num_steps={needed} reaches it"
        )
    observed = np.nonzero(np.isfinite(targets))
    observed_targets = targets[observed]
    interval, s = _place(times, t0, dt, num_steps)
    start = _read(scene, state, parameters)
    amplitude = _amplitude(targets)

    def predict(params: dict[str, Any]) -> Array:
        fitted_scene, fitted_state = _put(scene, state, params)
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

    stages = _horizons(times[observed[0]] - t0) if grow else ()
    result = fit(
        residual,
        start,
        positive={name: _is_positive(name) for name in start},
        scale={name: _speed(times, targets) if name == "velocity" else amplitude for name in start},
        optimizer=optimizer,
        max_iterations=max_iterations,
        tolerance=tolerance,
        stages=stages,
        progress=progress,
    )
    fitted_scene, fitted_state = _put(scene, state, result.params)
    return SpringFit(
        ks=_of_springs(fitted_scene, "ks"),
        kd=_of_springs(fitted_scene, "kd"),
        scene=fitted_scene,
        state=fitted_state,
        predicted=jax.jit(predict)(result.params),
        **{field.name: getattr(result, field.name) for field in dataclasses.fields(result)},
    )


def _observations(times: Any, positions: Any, shape: tuple[int, ...], t0: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and targets as float64 NumPy arrays, checked."""
    times, targets = np.asarray(times, float), np.asarray(positions, float)
    if times.ndim != 1 or not len(times):
        raise ValueError(f"times must have shape (time,) with at least one time, got {times.shape}")
    if targets.shape != (len(times), *shape):
        raise ValueError(
            f"positions must have shape (time, particle, dim) = {(len(times), *shape)}, got {targets.shape}"
        )
    if not np.isfinite(times).all():
        raise ValueError(f"times must be finite, got {times[~np.isfinite(times)][0]}; drop those rows")
    falls = np.flatnonzero(np.diff(times) < 0)
    if falls.size:
        k = falls[0]
        raise ValueError(f"times must not decrease, got {times[k]} then {times[k + 1]} at {k + 1}; sort the rows")
    if times[0] < t0:
        raise ValueError(
            f"times must lie in the simulated span, which begins at t0 = {t0} s, got {times[0]}; "
            f"pass t0, the time of the state, or drop the rows before it"
        )
    if np.isinf(targets).any():
        raise ValueError("positions must be finite, or NaN where not observed, got inf")
    if not np.isfinite(targets).any():
        raise ValueError("positions must have at least one finite value, got none: nothing was observed")
    return times, targets


def _place(times: np.ndarray, t0: float, dt: float, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The step interval of each time and the place in it, from 0 to 1."""
    steps = (times - t0) / dt
    interval = np.clip(np.floor(steps).astype(int), 0, num_steps - 1)
    return interval, steps - interval


def _horizons(times: np.ndarray) -> list[np.ndarray]:
    """Weights of the observations for a time horizon that doubles from a sixteenth of the span to a half."""
    weights = [(times <= times[-1] * share).astype(float) for share in (1 / 16, 1 / 8, 1 / 4, 1 / 2)]
    counts = [0.0, *(w.sum() for w in weights)]
    return [w for w, before in zip(weights, counts, strict=False) if w.sum() > before and w.sum() < len(times)]


def _amplitude(targets: np.ndarray) -> float:
    """Root mean square of the motion about its mean, m."""
    seen = np.isfinite(targets)
    mean = np.nansum(targets, axis=0) / np.maximum(seen.sum(axis=0), 1)
    rms = float(np.sqrt(np.mean((targets - mean)[seen] ** 2)))
    return rms if rms > 0 else 1.0


def _speed(times: np.ndarray, targets: np.ndarray) -> float:
    """Root mean square speed over a fiftieth of the samples, so that noise does not pass for speed, m/s."""
    lag = max(1, len(times) // 50)
    if len(times) <= lag:
        return 1.0
    span = np.maximum(times[lag:] - times[:-lag], 1e-300)[:, None, None]
    quotients = (targets[lag:] - targets[:-lag]) / span
    rms = float(np.sqrt(np.nanmean(quotients**2))) if np.isfinite(quotients).any() else 0.0
    return rms if np.isfinite(rms) and rms > 0 else 1.0


def _free(state: ParticleState) -> np.ndarray:
    """Which particles can move."""
    return np.broadcast_to(np.isfinite(np.asarray(state.mass)), state.position.shape[:1])


def _fields(force: Any) -> set[str]:
    """The names of a force's parameters."""
    if not dataclasses.is_dataclass(force):
        return set()
    return {field.name for field in dataclasses.fields(force)} - {"edges", "function"}


def _owners(scene: Scene, name: str) -> tuple[list[int], str]:
    """Which forces have the parameter "ks", or "forces[1].ks" for one of them, and its field's name."""
    one = re.fullmatch(r"forces\[(\d+)\]\.(\w+)", name)
    field = one.group(2) if one else name
    owners = [k for k, force in enumerate(scene.forces) if field in _fields(force)]
    return [k for k in owners if one is None or k == int(one.group(1))], field


def _of_springs(scene: Scene, name: str) -> Any:
    owners, field = _owners(scene, name)
    values = tuple(getattr(scene.forces[k], field) for k in owners)
    return values[0] if len(values) == 1 else values


def _is_positive(name: str) -> bool:
    return name.rpartition(".")[2] not in ("velocity", "position", "anchors", "acceleration")


def _read(scene: Scene, state: ParticleState, parameters: tuple[str, ...]) -> dict[str, Any]:
    """The starting values by name."""
    if isinstance(parameters, str) or not parameters:
        raise ValueError(f'parameters must be a tuple of names such as ("ks", "kd"), got {parameters!r}')
    free, dtype = _free(state), state.position.dtype
    start: dict[str, Any] = {}
    for name in parameters:
        if _owners(scene, name)[0]:
            start[name] = jax.tree.map(lambda x: jnp.asarray(x, dtype), _of_springs(scene, name))
        elif name not in STATE_PARAMETERS:
            known = sorted(set().union(*(_fields(force) for force in scene.forces)))
            raise ValueError(f"parameters must be among {(*known, *STATE_PARAMETERS)} for this scene, got {name!r}")
        elif name == "mass" and not state.mass.ndim:
            start[name] = state.mass
        else:
            rows = np.flatnonzero(~free if name == "anchors" else free)
            if not rows.size:
                kind = "pinned (mass = inf)" if name == "anchors" else "free"
                raise ValueError(f"parameters names {name!r}, but the state has no {kind} particle")
            start[name] = getattr(state, "position" if name == "anchors" else name)[rows]
    return start


def _put(scene: Scene, state: ParticleState, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
    """Scene and state with the parameters put in."""
    free = _free(state)
    forces = list(scene.forces)
    for name, value in params.items():
        owners, field = _owners(scene, name)
        for k, x in zip(owners, value if len(owners) > 1 else (value,), strict=False):
            forces[k] = _tree.replace(forces[k], **{field: x})
        if not owners and name == "mass" and not value.ndim:
            state = _tree.replace(state, mass=value)
        elif not owners:
            field = "position" if name == "anchors" else name
            rows = np.flatnonzero(~free if name == "anchors" else free)
            state = _tree.replace(state, **{field: getattr(state, field).at[rows].set(value)})
    return _tree.replace(scene, forces=tuple(forces)), state
