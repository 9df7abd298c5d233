"""Forces that are given as functions of time: what a shaker, a load cell or a hand was measured to do."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, Parameter, ParticleIndices, default
from jeuler._core.component import component, store_as_float
from jeuler._core.in_time import at_time, moving
from jeuler._core.indices import different_particles
from jeuler._core.limits import check_limits


@component(static=("particles",), parameters=("gain",))
class AppliedForce:
    """A force that is a given function of time, such as one that was measured.

        F_i = gain u(t)

    Args:
      force: u, (dim,) or one for each of the particles, (k, dim), N: a function of time, such as ``SampledPath(times,
        values)`` or ``SampledPath.band_limited(times, values)`` of samples, or constant. Differentiable in its leaves.
      particles: on which particles it acts, integers (k,); None for all. Static.
      gain: (), what one unit of u is worth; a parameter of fits. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if particles are no integers or repeated; in `simulate`, if an index is out of range or the
      force has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> push = jeuler.AppliedForce(lambda t: jnp.stack([2 * t, 0.0]), particles=[1], gain=3.0)
      >>> push(0.5, jnp.zeros((2, 2)), jnp.zeros((2, 2)), jnp.asarray(1.0)).tolist()
      [[0.0, 0.0], [3.0, 0.0]]
    """

    force: MovingParameter
    particles: ParticleIndices = default(None)
    gain: Parameter = default(1.0)

    limits: ClassVar[dict[str, Any]] = {"force": ("", "N"), "gain": ("", "")}

    def __post_init__(self) -> None:
        object.__setattr__(self, "force", moving("AppliedForce.force", self.force))
        if self.particles is not None:
            object.__setattr__(self, "particles", different_particles("AppliedForce.particles", self.particles))
        store_as_float(self, "gain")
        check_limits(self)

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        force = self.gain.astype(position.dtype) * at_time(self.force, t, position.dtype)
        if self.particles is None:
            return jnp.broadcast_to(force, position.shape)
        return jnp.zeros_like(position).at[self.particles[:]].set(force)

    def check(self, particles: int, dim: int) -> None:
        count = particles if self.particles is None else len(self.particles)
        if self.particles is not None:
            checks.indices("AppliedForce.particles", self.particles[:], particles)
        shape = jnp.shape(checks.form_of("AppliedForce.force", at_time, self.force, jnp.zeros(())))
        checks.shape("AppliedForce.force", shape, (dim,), (count, dim), meaning="(dim,) or one a particle")
        checks.shape("AppliedForce.gain", self.gain.shape, (), meaning="one number")
