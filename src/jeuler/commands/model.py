"""The model that is fitted: particles on springs, their friction, and the quantity that is observed."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.interpolate import hermite
from jeuler.commands.forces import Driving, DryFriction, Restoring, SignedQuadraticDrag
from jeuler.commands.selection import Measurement
from jeuler.fitting.observations import place_in_steps
from jeuler.forces import Springs
from jeuler.particles._simulate import simulate
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import rk4_step

FRICTIONS = ("viscous", "quadratic", "dry")


@dataclasses.dataclass(frozen=True)
class Model:
    """Particles on springs.

    Attributes:
      mass: (particle,), kg; NaN where it is fitted.
      pairs, anchored: particles joined with each other, and those joined with a fixed point each.
      friction: any of "viscous", "quadratic", "dry".
      observe: the observed quantity.
      pendulum: the restoring force is that of a pendulum.  cubic: it has a term in x^3.
      shared: all springs have one ks and one kd (recordings of one spring).
      spring_mass: the spring's own effective mass is fitted.
      slow: the speed below which dry friction is smoothed.
      drive: samples of a measured force, (sample,), the time of the first, and the step between them; None without.
    Positions are displacements from rest, so that springs keep their sign through zero; only where particles in a plane
    or in space are joined in pairs are they places; rest lengths and anchors are then fitted too (`places`).
    """

    mass: np.ndarray
    pairs: tuple[tuple[int, int], ...]
    anchored: tuple[int, ...]
    dim: int
    friction: tuple[str, ...] = ("viscous",)
    observe: str = "position"
    pendulum: bool = False
    cubic: bool = False
    shared: bool = False
    spring_mass: bool = False
    slow: float = 1.0
    drive: tuple[np.ndarray, float, float] | None = None

    @property
    def particles(self) -> int:
        """The number of moving particles."""
        return len(self.mass)

    @property
    def places(self) -> bool:
        """Whether positions are places rather than displacements from rest."""
        return bool(self.pairs) and self.dim > 1

    @property
    def labels(self) -> list[str]:
        """The springs by name: 1-anchor, 1-2."""
        if self.shared or self.pendulum or self.cubic:
            return ["1-anchor"]
        return [f"{k + 1}-anchor" for k in self.anchored] + [f"{i + 1}-{j + 1}" for i, j in self.pairs]

    def masses(self, params: dict[str, Any]) -> Any:
        """Mass of each particle, with the fitted values in place of NaN and the mass of the spring added."""
        mass = jnp.asarray(self.mass)
        if "mass" in params:
            mass = mass.at[np.flatnonzero(np.isnan(self.mass))].set(params["mass"])
        return mass + params["spring_mass"] if "spring_mass" in params else mass

    def scene(self, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
        """Forces and initial state."""
        n, anchors = self.particles, len(self.anchored) if self.pairs else 0
        ks = jnp.asarray(params["ks"])
        kd = jnp.asarray(params.get("kd", 0.0)) + jnp.zeros_like(ks)
        forces: list[Any] = []
        if not self.pairs:
            forces.append(Restoring(ks[:, None], kd[:, None], params.get("cubic"), self.pendulum))
        else:
            if anchors:
                edges = [(k, n + index) for index, k in enumerate(self.anchored)]
                forces.append(Springs(edges, ks[:anchors], kd[:anchors], 0.0))
            forces.append(Springs(list(self.pairs), ks[anchors:], kd[anchors:], params.get("rest_length", 0.0)))
        if "quadratic" in params:
            forces.append(SignedQuadraticDrag(params["quadratic"]))
        if "dry" in params:
            forces.append(DryFriction(params["dry"], jnp.asarray(self.slow)))
        if self.drive is not None:
            samples, begin, step = self.drive
            forces.append(Driving(params["gain"], jnp.asarray(samples), jnp.asarray(begin), jnp.asarray(step)))
        ends = params.get("anchors", jnp.zeros((anchors, self.dim)))
        state = ParticleState(
            jnp.concatenate([params["position"], ends]),
            jnp.concatenate([params["velocity"], jnp.zeros((anchors, self.dim))]),
            jnp.concatenate([self.masses(params), jnp.full(anchors, jnp.inf)]),
        )
        return Scene(forces=tuple(forces)), state

    def motion(self, params: dict[str, Any], dt: float, num_steps: int, t0: float) -> tuple[Array, Array, Array, Scene]:
        """Positions and velocities at the steps, the masses, and the scene."""
        scene, state = self.scene(params)
        run = simulate(
            scene,
            state,
            dt=dt,
            num_steps=num_steps,
            t0=t0,
            step=rk4_step,
            save=lambda t, now: (now.position, now.velocity),
        )
        return run.y[0], run.y[1], state.mass, scene

    def observed(self, params: dict[str, Any], scene: Scene, mass: Array, t: Array, p: Array, v: Array) -> Array:
        """What is observed at states (time, particle, dim) at times (time,)."""
        n = self.particles
        offset = params.get("offset", 0.0)
        if self.observe in ("position", "angle"):
            return p[:, :n] + offset
        if self.observe in ("velocity", "angular velocity"):
            return v[:, :n] + offset
        import jax

        acceleration = jax.vmap(lambda t, p, v: scene.without_effects().vector_field(t, (p, v), mass)[1])(t, p, v)
        return acceleration[:, :n] + offset

    def predict(self, params: dict[str, Any], times: np.ndarray, dt: float, t0: float, num_steps: int) -> Array:
        """What is observed at the times, (time, particle, dim): between steps by cubic Hermite interpolation."""
        p, v, mass, scene = self.motion(params, dt, num_steps, t0)
        interval, s = place_in_steps(times, t0, dt, num_steps)
        fraction, width = jnp.asarray(s)[:, None, None], jnp.asarray(dt)
        import jax

        a = jax.vmap(lambda p, v, t: scene.without_effects().vector_field(t, (p, v), mass)[1])
        at = t0 + dt * jnp.arange(num_steps + 1)
        position = hermite(fraction, width, p[interval], p[interval + 1], v[interval], v[interval + 1])
        if self.observe in ("position", "angle"):
            return position[:, : self.particles] + params.get("offset", 0.0)
        slope = a(p, v, at)
        velocity = hermite(fraction, width, v[interval], v[interval + 1], slope[interval], slope[interval + 1])
        return self.observed(params, scene, mass, jnp.asarray(times), position, velocity)


def steps_to(measured: Measurement, dt: float) -> int:
    """The number of steps that reach the last time."""
    return max(1, int(np.ceil(np.ptp(measured.times) / dt * (1 - 1e-12))))
