"""The model that is fitted: particles on springs, their friction, and the quantity that is observed."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.interpolate import hermite
from jeuler.commands.forces import Driving, DryFriction, Restoring, Samples, SignedQuadraticDrag
from jeuler.fitting.observations import place_in_steps
from jeuler.fitting.prediction import motion
from jeuler.forces import Springs
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
      moves_support: whether drive is the position of the support, about its mean, and no force.
      delay: (particle,), s by which each channel is late, NaN where it is fitted; with a drive, by which the motion is
        late against it; () without.
      reach: s, how far before the first time the run begins, so that late channels have their past.
      drift: the degree of the polynomial by which the zero moves.  span: first and last time, s.
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
    moves_support: bool = False
    delay: tuple[float, ...] = ()
    reach: float = 0.0
    drift: int = 0
    span: tuple[float, float] = (0.0, 1.0)

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
        mass: Any = self.mass
        if "mass" in params:
            mass = jnp.asarray(mass).at[np.flatnonzero(np.isnan(mass))].set(params["mass"])
        return mass + params["spring_mass"] if "spring_mass" in params else mass

    def delays(self, params: dict[str, Any]) -> Any:
        """The delay of each particle's channel, s, with the fitted values in place of NaN."""
        delay = jnp.asarray(self.delay)
        return delay.at[np.flatnonzero(np.isnan(self.delay))].set(params["delay"]) if "delay" in params else delay

    def zero(self, params: dict[str, Any], t: Array) -> Any:
        """What is read where nothing has moved: the offset and its drift, sum_k drift_k z^k with z from -1 to 1."""
        if not self.drift:
            return params.get("offset", 0.0)
        z = (2 * t - self.span[0] - self.span[1]) / (self.span[1] - self.span[0])
        powers = z[:, None] ** np.arange(1, self.drift + 1)
        return params.get("offset", 0.0) + jnp.einsum("td,dpa->tpa", powers, params["drift"])

    def grid(self, times: np.ndarray, dt: float) -> tuple[float, int]:
        """The time at which the run begins, and the number of steps that reach the last time."""
        begin = float(times[0]) - self.reach
        return begin, max(1, int(np.ceil((float(times[-1]) + self.reach - begin) / dt * (1 - 1e-12))))

    def scene(self, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
        """Forces and initial state."""
        n, anchors = self.particles, len(self.anchored) if self.pairs else 0
        ks = jnp.asarray(params["ks"])
        kd = jnp.asarray(params.get("kd", 0.0)) + jnp.zeros_like(ks)
        forces: list[Any] = []
        if not self.pairs:
            support = self._samples(params) if self.moves_support else None
            forces.append(Restoring(ks[:, None], kd[:, None], params.get("cubic"), support, self.pendulum))
        else:
            if anchors:
                edges = [(k, n + index) for index, k in enumerate(self.anchored)]
                forces.append(Springs(edges, ks[:anchors], kd[:anchors], 0.0))
            forces.append(Springs(list(self.pairs), ks[anchors:], kd[anchors:], params.get("rest_length", 0.0)))
        if "quadratic" in params:
            forces.append(SignedQuadraticDrag(params["quadratic"]))
        if "dry" in params:
            forces.append(DryFriction(params["dry"], jnp.asarray(self.slow)))
        if self.drive is not None and not self.moves_support:
            forces.append(Driving(params["gain"], self._samples(params)))
        ends = params.get("anchors", jnp.zeros((anchors, self.dim)))
        state = ParticleState(
            jnp.concatenate([params["position"], ends]),
            jnp.concatenate([params["velocity"], jnp.zeros((anchors, self.dim))]),
            jnp.concatenate([self.masses(params), jnp.full(anchors, jnp.inf)]),
        )
        return Scene(forces=tuple(forces)), state

    def _samples(self, params: dict[str, Any]) -> Samples:
        assert self.drive is not None
        values, begin, step = self.drive
        late = self.delays(params)[0] if self.delay else 0.0
        return Samples(jnp.asarray(values), jnp.asarray(begin) + late, jnp.asarray(step))

    def motion(self, params: dict[str, Any], dt: float, num_steps: int, t0: float) -> tuple[Array, Array, Array, Scene]:
        """Positions and velocities at the steps, the masses, and the scene."""
        scene, state = self.scene(params)
        p, v = motion(scene, state, dt=dt, num_steps=num_steps, t0=t0, step=rk4_step)
        return p, v, state.mass, scene

    def observed(self, params: dict[str, Any], scene: Scene, mass: Array, t: Array, p: Array, v: Array) -> Array:
        """What is observed at states (time, particle, dim) at times (time,)."""
        n = self.particles
        zero = self.zero(params, t)
        if self.observe in ("position", "angle"):
            return p[:, :n] + zero
        if self.observe in ("velocity", "angular velocity"):
            return v[:, :n] + zero
        acceleration = jax.vmap(lambda t, p, v: scene.without_effects().vector_field(t, (p, v), mass)[1])(t, p, v)
        return acceleration[:, :n] + zero

    def predict(self, params: dict[str, Any], times: np.ndarray, dt: float) -> Array:
        """What is observed at the times, (time, particle, dim): between steps by cubic Hermite interpolation."""
        t0, num_steps = self.grid(times, dt)
        return self._at_times(params, self.motion(params, dt, num_steps, t0), times, t0, num_steps, dt)

    def predict_and_trace(
        self, params: dict[str, Any], times: np.ndarray, dt: float, every: int
    ) -> tuple[Array, Array]:
        """`predict`, and what is observed at each ``every``-th step, of one run."""
        t0, num_steps = self.grid(times, dt)
        p, v, mass, scene = motion = self.motion(params, dt, num_steps, t0)
        t = t0 + dt * jnp.arange(num_steps + 1)[::every]
        at_steps = self.observed(params, scene, mass, t, p[::every], v[::every])
        return self._at_times(params, motion, times, t0, num_steps, dt), at_steps

    def _at_times(
        self,
        params: dict[str, Any],
        motion: tuple[Array, Array, Array, Scene],
        times: np.ndarray,
        t0: float,
        num_steps: int,
        dt: float,
    ) -> Array:
        if not self.delay or self.drive is not None:
            return self._between(params, motion, times, place_in_steps(times, t0, dt, num_steps), t0, dt)
        channels = []
        for k, late in enumerate(self.delays(params)):
            steps = (times - late - t0) / dt
            interval = jnp.clip(jnp.floor(steps).astype(int), 0, num_steps - 1)
            at = self._between(params, motion, times, (interval, steps - interval), t0, dt)
            channels.append(at[:, k])
        return jnp.stack(channels, axis=1)

    def _between(
        self,
        params: dict[str, Any],
        motion: tuple[Array, Array, Array, Scene],
        times: np.ndarray,
        place: tuple[Any, Any],
        t0: float,
        dt: float,
    ) -> Array:
        p, v, mass, scene = motion
        interval, s = place
        fraction, width = jnp.asarray(s)[:, None, None], jnp.asarray(dt)
        position = hermite(fraction, width, p[interval], p[interval + 1], v[interval], v[interval + 1])
        if self.observe in ("position", "angle"):
            return position[:, : self.particles] + self.zero(params, jnp.asarray(times))
        a = jax.vmap(lambda p, v, t: scene.without_effects().vector_field(t, (p, v), mass)[1])
        slope = a(p, v, t0 + dt * jnp.arange(len(p)))
        velocity = hermite(fraction, width, v[interval], v[interval + 1], slope[interval], slope[interval + 1])
        return self.observed(params, scene, mass, jnp.asarray(times), position, velocity)
