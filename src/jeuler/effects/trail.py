"""Trails: where each particle has been."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from jeuler._core import checks
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component
from jeuler.particles.fields import AFTER
from jeuler.particles.state import FieldForm


@component(static=("points", "every"))
class Trail:
    """The last places of each particle, that pictures draw as a line which fades.

        trail[i, k] = p_i(t - (k + 1) every dt) - p_i(t),   and 0 beyond the birth

    measured from where the particle is. Between samples the first place is that of the last sample. What moves a
    particle before the motion of a step moves its trail along.

    Args:
      points: how many places are kept, an integer >= 1. Static.
      every: steps from one to the next, an integer >= 1. Static.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with ``state.trail``,
      (particle, points, dim), m.
    Raises: ValueError, if points or every is below 1; in `simulate`, if an effect that acts after the motion follows.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.ones((1, 1)))
      >>> end = jeuler.simulate(jeuler.Scene(effects=(jeuler.Trail(3),)), state, dt=0.5, num_steps=4).y
      >>> end.trail[-1, 0, :, 0].tolist(), end.trail[2, 0, :, 0].tolist()
      ([-0.5, -1.0, -1.5], [-0.5, -1.0, -1.0])
    """

    points: int
    every: int = 1

    acts = AFTER
    needs: ClassVar[tuple[str, ...]] = ("clock", "the last place")

    def __post_init__(self) -> None:
        for name in ("points", "every"):
            object.__setattr__(self, name, checks.count(f"Trail.{name}", getattr(self, name), least=1))

    @property
    def sets(self) -> dict[str, Any]:
        return {"trail": FieldForm((self.points, "dim"), 0.0)}

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any, *, clock: Any = None) -> Any:
        ended = (t / dt + 0.5).astype(jnp.int32) if clock is None else clock[0] + 1
        ended = ended if state.steps is None else state.steps
        previous = state if previous is None else previous
        back = (previous.position - state.position)[:, None]
        places = state.trail + back
        sampled = jnp.concatenate([back, places[:, :-1]], axis=1)
        return state.replace(trail=jnp.where(ended % self.every == 1 % self.every, sampled, places))
