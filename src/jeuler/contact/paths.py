"""The way of each particle through one step: a parabola between impacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jeuler._core.choice import where
from jeuler._core.vectors import length, unit

SMALL_PART = 1e-6  # of the changes of velocity of a step: one from which nothing is to be read


class Path(NamedTuple):
    """Where each particle is in parts s from 0 to 1 of a step of length dt, after its last impact.

        x(s) = x + (s - s_x) way + (s - s_x)^2 bend / 2,   dx/ds = way + (s - s_x) bend = dt u(s)

    With the displacement d of the step and what its forces add to the velocity, dv, before any impact

        way = d - bend / 2,   bend = dt dv

    so that the path goes through both ends of the step and u changes by dv. For a constant force that is a parabola
    of the exact motion, whichever method made the step: explicit and symplectic Euler follow one with a velocity that
    is off by dt/2 times the acceleration, at each step the same. Impacts act on u, and so add no error of their own.
    """

    s: Array  # (particle,), when the last impact was
    x: Array  # (particle, dim), where, m
    way: Array  # (particle, dim), m
    bend: Array  # (particle, dim), m
    jump: Array  # (particle, dim), what impacts added to the velocity, m/s
    hit: Array  # (particle,), whether there was an impact
    support: Array  # (particle, dim), what of bend are normal forces of contacts that it stays in, m
    ride: Array  # (particle,), dx/ds along the support while it stays, m a step
    rub: Array  # (particle, dim), what of bend is friction of contacts that it stays in, m
    ground: Array  # (collider, particle, dim), how each collider pushes against bend, m; none where it has one contact

    def position(self, s: Array) -> Array:
        part = (s - self.s)[:, None]
        return self.x + part * (self.way + part / 2 * self.bend)

    def sizes(self) -> tuple[Array, Array, Array]:
        """The lengths of way, bend and support, (particle,), by which it is decided what happens."""
        return tuple(length(lax.stop_gradient(jnp.stack([self.way, self.bend, self.support]))))

    def least(self) -> Array:
        """What of bend, (particle,), m, is so little that nothing is to be read from it: iterations leave as much."""
        _, bend, support = self.sizes()
        return SMALL_PART * (bend + support)

    def speed(self, s: Array) -> Array:
        """dx/ds, m a step."""
        return self.way + (s - self.s)[:, None] * self.bend


def free_path(
    x: Array, displacement: Array, dv: Array, dt: Any, kick: Any = None, rub: Any = None, ground: Any = None
) -> Path:
    """The path of a step without impacts; ``kick`` is what of dv are normal forces of contacts that last, ``rub`` their
    friction, and ``ground`` what each collider gives to push against, (collider, particle, dim), m/s."""
    zero, bend = jnp.zeros(len(x), x.dtype), dt * dv
    ground = jnp.zeros((0, *x.shape), x.dtype) if ground is None else dt * ground
    way = displacement - bend / 2
    support, ride = (jnp.zeros_like(x), zero) if kick is None else (dt * kick, along(way + bend, dt * kick))
    rub = jnp.zeros_like(x) if rub is None else dt * rub
    return Path(zero, x, way, bend, jnp.zeros_like(x), zero > 0, support, ride, rub, ground)


def along(y: Array, support: Array) -> Array:
    """The component of y along the support, (particle,); it only decides what happens, and is not differentiated."""
    y, support = lax.stop_gradient((y, support))
    return jnp.sum(y * unit(support), axis=-1)


def share_of_the_force(
    x: Array, displacement: Array, v: Array, dv: Array, dt: Any, total: Callable[[Array], Array] = jnp.sum
) -> Array:
    """Theta, (particle, 1): how much of dt dv the displacement of the step holds, to the nearest half.

        d = dt v + theta dt dv:   0 explicit Euler, 1 symplectic and implicit Euler, 1/2 Heun, Runge-Kutta, leapfrog

    A contact force that acts through the whole step moves a particle by as much of its own impulse. Where dv is within
    rounding, or a millionth of that of all, as in equilibrium, theta is that of the others, weighted by dv^2; 1/2 where
    there are none.
    ``total`` sums over all particles.
    """
    along = jnp.sum((displacement - dt * v) * dv, axis=-1, keepdims=True)
    most = dt * jnp.sum(dv * dv, axis=-1, keepdims=True)
    size = jnp.max(jnp.abs(x) + jnp.abs(displacement), axis=-1, keepdims=True)
    clear = dt * most > (16 * jnp.finfo(x.dtype).eps * size) ** 2
    along, most = where(clear, along, 0), where(clear, most, 0)
    of_all = total(most)
    others = where(of_all > 0, total(along) / where(of_all > 0, of_all, 1), 0.5)
    clear = most > SMALL_PART**2 * of_all
    part = where(clear, along / where(clear, most, 1), others)
    return lax.stop_gradient(jnp.clip(jnp.round(2 * part) / 2, 0, 1))
