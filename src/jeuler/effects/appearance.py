"""How particles look as they age, and how fast they may go."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.components import per_particle
from jeuler._core.vectors import direction
from jeuler.particles.fields import START
from jeuler.particles.state import DEFAULTS

NOT_DRAWN = (
    "position", "velocity", "mass", "alive", "age", "lifetime", "births", "missed_births", "steps", "frames", "force",
    "extra",
)  # fmt: skip


@component(static=("field",))
class OverLife:
    """A field that follows a curve over each particle's life: colour, opacity, size, shape, or one of your own.

        s = age / lifetime,   field = the line through (times_k, values_k), at s

    Before the first time and after the last one, the value there. ``shape`` takes the nearest lower key instead.

    Args:
      field: "color", "opacity", "size", "shape" or the name of an extra field. Static.
      values: (key, ...), what the field is at the keys. Differentiable.
      times: (key,), the keys' shares of life, increasing, 0 at birth and 1 at death; None spaces them evenly.
      duration: () s, the same span for all; None takes ``state.lifetime``.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with the field of each particle at
      its age.
    Raises: ValueError, if values and times differ in length or times do not increase; in `simulate`, if nothing in the
      scene provides age (a `Lifetime` does) or lifetime, or another effect writes the field.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene(effects=(jeuler.Lifetime(1.0), jeuler.OverLife("opacity", [1.0, 0.0], duration=1.0)))
      >>> state = jeuler.ParticleState(jnp.ones((1, 2)), jnp.zeros((1, 2)))
      >>> jeuler.simulate(scene, state, dt=0.25, num_steps=3).y.opacity[:, 0].tolist()
      [1.0, 0.75, 0.5, 0.25]

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983, sect. 2.3.
    """

    field: str
    values: Parameter
    times: OptionalParameter = default(None)
    duration: OptionalParameter = default(None)

    acts = START
    needs: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.field, str):
            raise ValueError(
                f'OverLife.field must be the name of a field, such as "opacity", got {checks.shown(self.field)}'
            )
        if self.field in NOT_DRAWN:
            raise ValueError(f"OverLife.field must be a field that is drawn or one of your own, got {self.field!r}")
        if self.field == "shape" and isinstance(self.values, (list, tuple)):
            object.__setattr__(self, "values", jnp.asarray(self.values, float))
        store_as_float(self, "values", "times", "duration")
        if self.values.ndim < 1 or len(self.values) < 1:
            raise ValueError(f"OverLife.values must have shape (key, ...), got {self.values.shape}")
        if self.times is not None and self.times.shape != self.values.shape[:1]:
            raise ValueError(
                f"OverLife.times must have one time for each of the {len(self.values)} values, got {self.times.shape}"
            )
        if self.times is not None:
            checks.increasing("OverLife.times", self.times)
            checks.finite("OverLife.times", self.times)
        if self.duration is not None:
            checks.positive("OverLife.duration", self.duration, "s")

    @property
    def reads(self) -> tuple[str, ...]:
        return ("age",) if self.duration is not None else ("age", "lifetime")

    @property
    def sets(self) -> dict[str, tuple[int, ...]]:
        return {self.field: self.values.shape[1:]}

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        field = getattr(state, self.field)
        life = state.lifetime if self.duration is None else self.duration
        life = jnp.where(life > 0, life, 1)  # a dead slot has none
        times = jnp.linspace(0.0, 1.0, len(self.values)) if self.times is None else self.times
        value = along(state.age / life, times.astype(state.age.dtype), self.values, stepwise=self.field == "shape")
        return state.replace(**{self.field: value.astype(field.dtype)})

    def check(self, particles: int, dim: int) -> None:
        if self.field in DEFAULTS and self.values.shape[1:] != DEFAULTS[self.field][0]:
            raise ValueError(
                f'OverLife("{self.field}").values must have shape (key, *{DEFAULTS[self.field][0]}), '
                f"got {self.values.shape}"
            )


def along(s: Array, times: Array, values: Array, *, stepwise: bool) -> Array:
    """The piecewise linear (or constant) curve through the keys, at each s: (particle,) to (particle, ...).

    A sum of clipped ramps, one a key: no gather, so it costs a few operations a key and particle.
    """
    rest = (1,) * (values.ndim - 1)
    total = jnp.broadcast_to(values[0], (*s.shape, *values.shape[1:]))
    for k in range(1, len(values)):
        if stepwise:
            share = (s >= times[k]).astype(values.dtype)
        else:
            share = jnp.clip((s - times[k - 1]) / (times[k] - times[k - 1]), 0, 1)
        total = total + share.reshape(-1, *rest) * (values[k] - values[k - 1])
    return total


@component(positive=("limit",))
class SpeedLimit:
    """No particle faster than a limit; the direction is kept.

        v <- v min(1, limit / |v|)

    Args:
      limit: () or (particle,), m/s, >= 0. Differentiable.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with slower velocities.
    Raises: ValueError, if a limit is negative; in `simulate`, if it has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.array([[3.0, 4.0]]))
      >>> scene = jeuler.Scene(effects=(jeuler.SpeedLimit(2.5),))
      >>> jeuler.simulate(scene, state, dt=0.1, num_steps=1).y.velocity[-1].tolist()
      [[1.5, 2.0]]

    Source: C. W. Reynolds, Steering Behaviors for Autonomous Characters, 1999, "Simple Vehicle Model".
    """

    limit: Parameter

    needs: ClassVar[tuple[str, ...]] = ("forward time",)

    def __post_init__(self) -> None:
        store_as_float(self, "limit")
        if not checks.is_traced(self.limit) and not (np.asarray(self.limit) >= 0).all():
            raise ValueError(f"SpeedLimit.limit must be at least 0 m/s, got {checks.shown(self.limit.tolist())}")

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        speed, heading = direction(state.velocity)
        limit = per_particle(self.limit)
        slow = jnp.where(speed > limit, limit * heading, state.velocity)
        return state.replace(velocity=slow.astype(state.velocity.dtype))

    def check(self, particles: int, dim: int) -> None:
        checks.shape("SpeedLimit.limit", self.limit.shape, (), (particles,))
