"""Particles whose motion is given: hands that hold a rope, a head that carries hair."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, Parameter, ParticleIndices
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import as_component, component, replace, store_as_float
from jeuler._core.interpolate import interpolate, slopes, upsampled
from jeuler.particles.strips import ON_PATHS


@component()
class SampledPath:
    """A path through samples, as a motion capture gives it: piecewise cubic, with slopes from finite differences.

    Before the first sample and after the last the path rests there.

    Args:
      times: increasing sample times, shape (sample,), s; two at least.
      positions: sample positions, shape (sample, ...), m. Differentiable.
    Returns: called as ``path(t)``, the position at time t, shape (...), m.
    Raises: ValueError, if times decrease or repeat, a number is not finite, or the two lengths differ.
    Example:
      >>> import jeuler
      >>> path = jeuler.SampledPath([0.0, 1.0, 2.0], [[0.0, 0.0], [1.0, 1.0], [2.0, 4.0]])
      >>> path(1.5).tolist()
      [1.5, 2.25]

    Source: C. de Boor, A Practical Guide to Splines, 1978, ch. IV (cubic Hermite interpolation).
    """

    times: Parameter
    positions: Parameter

    def __post_init__(self) -> None:
        store_as_float(self, "times", "positions")
        times = self.times
        for name in ("times", "positions"):
            checks.finite(f"SampledPath.{name}", getattr(self, name))
        if times.ndim != 1 or len(times) < 2 or self.positions.shape[:1] != times.shape:
            raise ValueError(
                f"SampledPath.times must have shape (sample,) with two samples at least and positions (sample, ...), "
                f"got {times.shape} and {self.positions.shape}"
            )
        checks.increasing("SampledPath.times", times)

    @classmethod
    def band_limited(cls, times: Any, values: Any, *, finer: int = 8) -> SampledPath:
        """The path of a signal that has nothing above 0.4 of its sampling rate, through evenly spaced samples.

            x(t) = sum_k x_k w(t / h - k) sin(pi (t / h - k)) / (pi (t / h - k))

        A cubic through the samples themselves loses what is above a tenth of the sampling rate. Here the samples are
        first interpolated on a grid ``finer`` times as fine, by the sinc under a Kaiser window w of 16 samples to each
        side; beyond the ends the signal counts as mirrored through its end points.

        Args:
          times: evenly spaced sample times, (sample,), s; two at least.
          values: samples, (sample, ...).
          finer: how many points of the fine grid a sample.
        Returns: `SampledPath`.
        Raises: ValueError, if the times are not evenly spaced, or as `SampledPath`.
        Example:
          >>> import numpy as np, jeuler
          >>> t = np.arange(100) * 0.1
          >>> path = jeuler.SampledPath.band_limited(t, np.sin(2 * np.pi * 2.5 * t))  # four samples a period
          >>> round(float(path(5.05)), 3), round(float(np.sin(2 * np.pi * 2.5 * 5.05)), 3)
          (-0.707, -0.707)

        Source: J. F. Kaiser, Nonrecursive digital filter design using the I0-sinh window function, 1974.
        """
        finer = checks.count("SampledPath.band_limited finer", finer, least=1)
        given = cls(times, values)
        t, x = np.asarray(times, float), np.asarray(values, float)
        step = (t[-1] - t[0]) / (len(t) - 1)
        off = np.abs(t - (t[0] + step * np.arange(len(t))))
        if off.max() > 1e-3 * step:
            raise ValueError(
                f"SampledPath.band_limited needs evenly spaced times, got one {off.max():.3g} s off a grid of "
                f"{step:.6g} s; use SampledPath(times, values), or resample"
            )
        fine = t[0] + step / finer * np.arange((len(t) - 1) * finer + 1)
        return cls(fine, upsampled(x, finer).astype(np.asarray(given.positions).dtype))

    def __call__(self, t: Any) -> Array:
        return interpolate(t, self.times, self.positions, slopes(self.times, self.positions))


@component(static=("particles",))
class PrescribedMotion:
    """Particles that follow a given path, whatever forces act on them.

        p_k(t) = path(t)_k,   v_k(t) = d path_k / dt

    Springs feel their exact position and velocity at every stage of every step. Give them mass = inf, or any mass.

    Args:
      particles: indices of the prescribed particles, integers (prescribed,). Static.
      path: a function ``path(t) -> (prescribed, dim)`` in m, or a `SampledPath`. A path that is a pytree, such as
        `SampledPath` or ``jax.tree_util.Partial``, is differentiable in its leaves.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with these particles on their path
      at time t.
    Raises: ValueError, if an index is no integer or the path is no function of t; in `simulate`, if an index is out
      of range or repeated, or the path has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> hand = jeuler.PrescribedMotion([0], lambda t: jnp.stack([jnp.sin(t), 0.0 * t])[None])
      >>> state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.zeros((1, 2)))
      >>> end = jeuler.simulate(jeuler.Scene(effects=(hand,)), state, dt=0.5, num_steps=2)
      >>> round(float(end.y.position[-1, 0, 0]), 5), round(float(end.y.velocity[-1, 0, 0]), 5)
      (0.84147, 0.5403)

    Source: A. Witkin, Particle System Dynamics, SIGGRAPH course notes, 1997, sect. 4 (user interaction).
    """

    particles: ParticleIndices
    path: MovingParameter

    needs: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        given = list(self.particles) if isinstance(self.particles, range) else self.particles
        indices = checks.integers("PrescribedMotion.particles", given, "integers, particle indices")
        object.__setattr__(self, "particles", tuple(map(int, indices.ravel())))
        checks.refuse_class("PrescribedMotion.path must be a function of time or a SampledPath", self.path)
        hint = "write lambda t: jnp.asarray(points), or a SampledPath(times, positions)"
        checks.function("PrescribedMotion.path", self.path, "(t) -> (prescribed, dim)", hint)
        object.__setattr__(self, "path", as_component(self.path))

    def prescribe(self, t: Any, dtype: Any) -> tuple[Any, Array, Array, Array]:
        """Indices, position, velocity and acceleration of the particles at time t."""

        def motion(t):
            return jax.jvp(self.path, (t,), (jnp.ones_like(t),))

        t = jnp.asarray(t)
        (p, v), (_, a) = jax.jvp(motion, (t,), (jnp.ones_like(t),))
        return self.particles, p.astype(dtype), v.astype(dtype), a.astype(dtype)

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        indices, p, v, _ = self.prescribe(t, state.position.dtype)
        at = jnp.array(indices, int)
        return replace(state, position=state.position.at[at].set(p), velocity=state.velocity.at[at].set(v))

    def check(self, particles: int, dim: int) -> None:
        indices = self.particles
        if len(set(indices)) < len(indices) or not all(0 <= k < particles for k in indices):
            raise ValueError(
                f"PrescribedMotion.particles must be different indices from 0 to {particles - 1}, got {list(indices)}"
            )
        form = checks.form_of("PrescribedMotion.path", self.path, jnp.zeros(()))
        shape = getattr(form, "shape", None)
        if shape is None:
            came = type(form).__name__
            raise ValueError(f"PrescribedMotion.path(t) must be one array (prescribed, dim), got a {came}")
        checks.shape("PrescribedMotion.path(t)", shape, (len(indices), dim), meaning="(prescribed, dim)")


ON_PATHS.add(PrescribedMotion)
