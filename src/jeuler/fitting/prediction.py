"""What a scene predicts at the times of a recording: the residual of ``fit_springs``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.interpolate import hermite
from jeuler.fitting.forward import Forward, in_a_loop
from jeuler.fitting.observations import place_in_steps
from jeuler.fitting.parameters import Places
from jeuler.fitting.unknowns import Layout
from jeuler.particles._simulate import simulate
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.solving.grid import Checkpoint
from jeuler.steps.explicit import Step


def motion(scene: Scene, state: ParticleState, **how: Any) -> tuple[Array, Array]:
    """Positions and velocities at the ends of the steps, (step + 1, particle, dim), of a run as `simulate` takes it."""
    return simulate(scene, state, save=lambda t, now: (now.position, now.velocity), **how).y


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Positions at the times of a recording, and the residual against it. Hashable: programs are kept by it.

    What changes from fit to fit of the same shape, the numbers, is in the data (`recording`).
    """

    places: Places
    step: Step
    num_steps: int
    columns: tuple[int, ...]  # of position.ravel(), those that were observed
    checkpoint: Checkpoint = None

    def positions(self, params: dict[str, Any], data: dict[str, Any]) -> Array:
        """Positions of all particles at the times, (time, particle, dim), m."""
        scene, state = self.places.put(data["scene"], data["state"], params)
        how: dict[str, Any] = {"num_steps": self.num_steps, "step": self.step, "checkpoint": self.checkpoint}
        p, v = motion(scene, state, dt=data["dt"], t0=data["t0"], key=data["key"], **how)
        k, s = data["interval"], data["fraction"].astype(p.dtype)[:, None, None]
        return hermite(s, data["dt"].astype(p.dtype), p[k], p[k + 1], v[k], v[k + 1])

    def form(self, data: dict[str, Any]) -> jax.ShapeDtypeStruct:
        """The form of the residual."""
        return jax.ShapeDtypeStruct(data["targets"].shape, data["state"].position.dtype)

    def in_loops(self) -> Prediction:
        """The same, with the stages of a Runge-Kutta step in a loop: quicker to compile."""
        return dataclasses.replace(self, step=in_a_loop(self.step))

    def forward(self, layout: Layout, data: dict[str, Any]) -> Forward:
        """The same with derivatives by forward mode, in one program of its own."""
        return Forward.of(self, layout, data)

    def __call__(self, params: dict[str, Any], data: dict[str, Any]) -> Array:
        """Prediction minus measurement where something was observed, 0 elsewhere, (time, column), m."""
        predicted = self.positions(params, data)
        seen = predicted.reshape(len(predicted), -1)[:, np.asarray(self.columns, int)]
        return jnp.where(data["observed"], seen - data["targets"].astype(seen.dtype), 0)


def recording(
    scene: Scene,
    state: ParticleState,
    times: Any,
    targets: Any,
    columns: Any,
    *,
    dt: float,
    t0: float,
    num_steps: int,
    key: Any = None,
) -> dict[str, Any]:
    """The data of a `Prediction`."""
    interval, fraction = place_in_steps(np.asarray(times), t0, dt, num_steps)
    xp: Any = np if isinstance(targets, np.ndarray) else jnp
    seen = targets.reshape(len(targets), -1)[:, np.asarray(columns, int)]
    return {
        "scene": scene,
        "state": state,
        "dt": np.asarray(dt, float),
        "t0": np.asarray(t0, float),
        "key": key,
        "interval": interval,
        "fraction": fraction,
        "targets": xp.where(xp.isfinite(seen), seen, 0),
        "observed": xp.isfinite(seen),
    }


@functools.lru_cache(maxsize=32)
def compiled_positions(prediction: Prediction) -> Callable[[dict[str, Any], dict[str, Any]], Array]:
    """`Prediction.positions`, compiled once for recordings of one shape."""
    return jax.jit(prediction.positions)
