"""Deaths: by age, by a condition, by leaving a box, by touching a surface. They come before the motion of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import ColliderParameter, OptionalParameter, Parameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import Limits
from jeuler.contact.colliders import as_collider, check_collider
from jeuler.particles.fields import BEFORE


@component(static=("frames",))
class Lifetime:
    """Ageing, and death by age.

        a particle with age >= lifetime dies; then age <- age + dt

    Args:
      duration: the same lifetime for all, (), s, > 0; None takes ``state.lifetime``, which an `Emitter` draws.
      frames: in place of the duration, the number of steps that each lives, an integer >= 1, whatever dt is: they are
        counted in ``state.frames``. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with deaths and ages.
    Raises: ValueError, if the duration is not above 0, frames is no integer above 0, or both are given.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene(effects=(jeuler.Lifetime(0.2),))
      >>> state = jeuler.ParticleState(jnp.ones((1, 2)), jnp.zeros((1, 2)))
      >>> jeuler.simulate(scene, state, dt=0.1, num_steps=3).y.alive[:, 0].tolist()
      [True, True, True, False]
      >>> scene = jeuler.Scene(effects=(jeuler.Lifetime(frames=1),))
      >>> jeuler.simulate(scene, state, dt=0.1, num_steps=3).y.alive[:, 0].tolist()
      [True, True, False, False]

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983, sect. 2.4.
    """

    duration: OptionalParameter = default(None)
    frames: int | None = None

    acts = BEFORE
    needs: ClassVar[tuple[str, ...]] = ("forward time",)
    writes: ClassVar[tuple[str, ...]] = ("alive",)

    def __post_init__(self) -> None:
        if self.duration is not None and self.frames is not None:
            raise ValueError("Lifetime must have a duration in s or a number of frames, got both; leave one out")
        if self.duration is not None:
            checks.positive("Lifetime.duration", self.duration, "s")
        if self.frames is not None:
            object.__setattr__(self, "frames", checks.count("Lifetime.frames", self.frames, least=1))
        store_as_float(self, "duration")

    @property
    def reads(self) -> tuple[str, ...]:
        return ("lifetime",) if self.duration is None and self.frames is None else ()

    @property
    def sets(self) -> tuple[str, ...]:
        return ("age",) if self.frames is None else ("age", "frames")

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        age = state.age + dt.astype(state.age.dtype)
        if self.frames is not None:
            return state.replace(alive=state.alive & (state.frames < self.frames), age=age, frames=state.frames + 1)
        limit = state.lifetime if self.duration is None else self.duration
        # ages are sums of dt: a lifetime of three steps ends after three, not four; 1,000 sums in float32 are 3 % off
        steps = jnp.minimum(limit / dt, 1e9)
        small = dt * jnp.minimum(1e-3 + jnp.finfo(state.age.dtype).eps * steps**2 / 4, 0.45)
        return state.replace(alive=state.alive & (state.age < limit - small), age=age)


@component(static=("condition",))
class Death:
    """Death where a condition holds.

    Args:
      condition: a function ``condition(t, state) -> (particle,)`` boolean. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state without the particles for which it holds.
    Raises: ValueError, if the condition is not a function of (t, state); in `simulate`, if it does not return booleans.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> too_hot = jeuler.Death(lambda t, state: state.temperature > 100.0)
      >>> state = jeuler.ParticleState(jnp.zeros((2, 1)), jnp.zeros((2, 1)), extra={"temperature": [20.0, 120.0]})
      >>> jeuler.simulate(jeuler.Scene(effects=(too_hot,)), state, dt=0.1, num_steps=1).y.alive[-1].tolist()
      [True, False]
    """

    condition: Callable[[Any, Any], Array]

    acts = BEFORE
    needs: ClassVar[tuple[str, ...]] = ("forward time",)
    writes: ClassVar[tuple[str, ...]] = ("alive",)

    def __post_init__(self) -> None:
        hint = "write Death(lambda t, state: state.position[:, 1] < 0)"
        checks.function("Death.condition", self.condition, "(t, state) -> (particle,) boolean", hint)

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        dying = jnp.asarray(self.condition(t, state))
        if dying.dtype != bool or dying.shape not in ((), state.alive.shape):
            raise ValueError(
                f"Death.condition must return a boolean a particle, {state.alive.shape}, got {dying.dtype} of shape "
                f"{dying.shape}; write a comparison, such as state.position[:, 1] < 0"
            )
        return state.replace(alive=state.alive & ~dying)


@component()
class DeathOutside:
    """Death by leaving a box. A particle whose position is not a number is outside.

    Args:
      low: (dim,) or (), m; -inf leaves a side open.
      high: (dim,) or (), m.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state without the particles outside.
    Raises: ValueError, if low is above high; in `simulate`, if a bound has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene(effects=(jeuler.DeathOutside(low=[-1.0, -1.0], high=[1.0, 1.0]),))
      >>> state = jeuler.ParticleState(jnp.array([[0.0, 0.0], [0.0, 2.0]]), jnp.zeros((2, 2)))
      >>> jeuler.simulate(scene, state, dt=0.1, num_steps=1).y.alive[-1].tolist()
      [True, False]
    """

    low: Parameter
    high: Parameter

    acts = BEFORE
    needs: ClassVar[tuple[str, ...]] = ("forward time",)
    writes: ClassVar[tuple[str, ...]] = ("alive",)

    def __post_init__(self) -> None:
        store_as_float(self, "low", "high")
        checks.fit_together("DeathOutside", low=self.low, high=self.high)
        checks.in_order("DeathOutside.low", self.low, "DeathOutside.high", self.high)

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        inside = jnp.all((state.position >= self.low) & (state.position <= self.high), axis=1)
        return state.replace(alive=state.alive & inside)

    def check(self, particles: int, dim: int) -> None:
        for name in ("low", "high"):
            checks.shape(f"DeathOutside.{name}", getattr(self, name).shape, (), (dim,))


@component()
class DeathOnContact:
    """Death by touching a surface.

        a particle dies where distance(t, p) <= margin

    Args:
      collider: the signed distance ``collider(t, point) -> ()`` of one point (dim,), m, negative inside; what
        `Collisions` takes too.
      margin: (), m, how near is contact.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state without the particles in contact.
    Raises: ValueError, in `simulate`, if the collider is of another dimension, or the margin is not one number.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> ground = jeuler.DeathOnContact(lambda t, p: p[1])
      >>> state = jeuler.ParticleState(jnp.array([[0.0, -1.0], [0.0, 2.0]]), jnp.zeros((2, 2)))
      >>> jeuler.simulate(jeuler.Scene(effects=(ground,)), state, dt=0.1, num_steps=1).y.alive[-1].tolist()
      [False, True]

    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983,
      sect. 2 (particle extinction).
    """

    collider: ColliderParameter
    margin: Parameter = default(0.0)

    acts = BEFORE
    limits: ClassVar[Limits] = {"margin": ("", "m")}
    needs: ClassVar[tuple[str, ...]] = ("forward time",)
    writes: ClassVar[tuple[str, ...]] = ("alive",)

    def __post_init__(self) -> None:
        object.__setattr__(self, "collider", as_collider("DeathOnContact.collider", self.collider))
        store_as_float(self, "margin")

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        distance = jax.vmap(self.collider, (None, 0))(t, state.position)
        return state.replace(alive=state.alive & (distance > self.margin))

    def check(self, particles: int, dim: int) -> None:
        checks.shape("DeathOnContact.margin", self.margin.shape, ())
        check_collider(self.collider, dim)
