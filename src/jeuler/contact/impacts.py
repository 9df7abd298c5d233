"""Impacts: when on its way through a step a particle meets a collider or another ball, and what it does to it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core.vectors import length, unit
from jeuler._jax.root import root
from jeuler.contact.colliders import Collider, normal_and_speed

MAX_STRIDES = 100  # along one path; a path that grazes a surface needs many
NEWTON_STEPS = 5


class Path(NamedTuple):
    """The way of each particle through one step, in parts s from 0 to 1 of it; straight between impacts.

        x(s) = x + (s - s_x) (drift + dt jump),   v(s) = drift/dt + (s - 1/2) dv + jump

    The displacement of a step holds the velocity at its middle, whichever Euler step made it; counted from there, the
    energy of an elastic bounce is kept to second order.
    """

    s: Array  # (particle,), when the last impact was
    x: Array  # (particle, dim), where
    drift: Array  # (particle, dim), the step's own displacement
    dv: Array  # (particle, dim), what forces added to the velocity
    jump: Array  # (particle, dim), what impacts added to it
    flying: Array  # (particle,), whether something may be in the way

    def displacement(self, dt: Any) -> Array:
        return self.drift + dt * self.jump

    def velocity(self, s: Array, dt: Any) -> Array:
        return self.drift / dt + (s[:, None] - 0.5) * self.dv + self.jump


class Impacts:
    """The impacts of one step of length dt from t0, for one `Collisions`."""

    t0: Array
    dt: Array
    colliders: tuple[Collider, ...]
    restitution: Array
    friction: Array
    radius: Array
    inverse_mass: Array
    i: np.ndarray
    j: np.ndarray
    both_alive: Any

    def __init__(self, contact: Any, t0: Array, dt: Array, x: Array, mass: Array, alive: Array | None) -> None:
        self.t0, self.dt = t0.astype(x.dtype), dt.astype(x.dtype)
        self.colliders = contact.colliders
        self.restitution = contact.restitution.astype(x.dtype)
        self.friction = contact.friction.astype(x.dtype)
        self.radius = jnp.broadcast_to(contact.radius.astype(x.dtype), len(x))
        mass = mass if alive is None else jnp.where(alive, mass, jnp.inf)  # whatever the mass of a dead slot is
        self.inverse_mass = jnp.broadcast_to(1 / mass.astype(x.dtype), len(x))
        self.i, self.j = np.array(contact.pairs, np.int32).reshape(-1, 2).T
        self.both_alive = True if alive is None else alive[self.i] & alive[self.j]

    def gap(self, collider: Collider, s: Array, x: Array) -> Array:
        """The distance between the surfaces of collider and particles, (particle,), m."""
        return jax.vmap(collider)(self.t0 + s * self.dt, x) - self.radius

    def roundoff(self, x: Array) -> Array:
        """What a gap of zero may look like, (particle,), m."""
        return 16 * jnp.finfo(x.dtype).eps * (jnp.max(jnp.abs(x), axis=-1) + self.radius)

    def next_impact(self, path: Path) -> Path:
        """The path after the next impact of each particle, where there is one."""
        wall_times = [self.time_of_impact(collider, path) for collider in self.colliders]
        ball_times = self.time_of_meeting(path) if len(self.i) else jnp.zeros(0)
        first = jnp.full(path.s.shape, jnp.inf, path.s.dtype)
        for times in wall_times:
            first = jnp.minimum(first, times)
        if len(self.i):
            first = first.at[self.i].min(ball_times).at[self.j].min(ball_times)

        s = jnp.where(jnp.isfinite(first), first, path.s)
        x = path.x + (s - path.s)[:, None] * path.displacement(self.dt)
        v, change = path.velocity(s, self.dt), jnp.zeros_like(path.dv)
        done = jnp.zeros(len(s), bool)
        for collider, times in zip(self.colliders, wall_times, strict=True):
            now = jnp.isfinite(times) & (times == first) & ~done
            normal, recession = jax.vmap(normal_and_speed, (None, 0, 0))(collider, self.t0 + s * self.dt, x)
            bounce, _ = self.bounce(v, normal, recession, self.restitution)
            change = change + jnp.where(now[:, None], bounce, 0)
            done = done | now
        if len(self.i):
            now = self.first_of_their_balls(jnp.isfinite(ball_times), ball_times, first, done)
            change = change + self.exchange(now, x, v, self.restitution)
            done = done.at[self.i].max(now).at[self.j].max(now)
        return path._replace(
            s=jnp.where(done, s, path.s),
            x=jnp.where(done[:, None], x, path.x),
            jump=path.jump + change,
            flying=jnp.isfinite(first),  # who met nothing flies on as before, and need not be searched again
        )

    def time_of_impact(self, collider: Collider, path: Path) -> Array:
        """When each particle meets the collider next, a part of the step, inf where it does not; (particle,)."""
        way = path.displacement(self.dt)

        def gap(s):
            return self.gap(collider, s, path.x + (s - path.s)[:, None] * way)

        def slope(s):
            return jax.jvp(gap, (s,), (jnp.ones_like(s),))

        def search(gap, start):
            """Strides of the length of the gap, which cannot cross a surface, then Newton's method."""
            _, recession = jax.vmap(normal_and_speed, (None, 0, 0))(collider, self.t0 + start * self.dt, path.x)
            stride = length(way) + jnp.abs(recession) * self.dt
            safe_stride = jnp.where(stride > 0, stride, 1)

            def far(state):
                s, distance, n = state
                return path.flying & (distance > 1e-3 * stride) & (s <= 1) & (n < MAX_STRIDES)

            def advance(state):
                s, distance, n = state
                s = jnp.where(far(state), s + distance / safe_stride, s)
                return s, gap(s), n + 1

            s, _, _ = lax.while_loop(lambda state: jnp.any(far(state)), advance, (start, gap(start), 0))

            def newton(_, s):
                distance, rate = slope(s)
                return jnp.where(rate < 0, jnp.maximum(start, s - distance / jnp.where(rate < 0, rate, -1)), s)

            return lax.fori_loop(0, NEWTON_STEPS, newton, s)

        def solve(gap, start):
            s = search(gap, start)
            roundoff = self.roundoff(path.x)
            distance, rate = slope(start)
            touching = (distance <= roundoff) & (rate < -roundoff)  # a slower approach is rounding, not an impact
            inside = distance < -roundoff  # overlap from the start: no root to follow
            distance, rate = slope(s)
            meeting = (s <= 1) & (rate < -roundoff) & (jnp.abs(distance) <= roundoff + 1e-6 * length(way))
            return s, (touching, inside, meeting)

        def tangent_solve(matvec, b):
            rate = matvec(jnp.ones_like(b))
            return jnp.where(rate < 0, b / jnp.where(rate < 0, rate, -1), 0)

        s, (touching, inside, meeting) = root(gap, path.s, solve, tangent_solve)
        at_once = jnp.where(inside, path.s, lax.stop_gradient(path.s - s) + s)  # value path.s, slope of the root
        s = jnp.where(touching, at_once, jnp.where(meeting, s, jnp.inf))
        return jnp.where(path.flying & (self.inverse_mass > 0), s, jnp.inf)

    def time_of_meeting(self, path: Path) -> Array:
        """When the two balls of each pair meet next, a part of the step, inf where they do not; (pair,)."""
        way = path.displacement(self.dt)
        start = jnp.maximum(path.s[self.i], path.s[self.j])

        def at_start(k):
            return path.x[k] + (start - path.s[k])[:, None] * way[k]

        # |apart + (s - start) way| = reach, the first root
        apart, way = at_start(self.i) - at_start(self.j), way[self.i] - way[self.j]
        a, b = jnp.sum(way * way, axis=-1), jnp.sum(apart * way, axis=-1)
        c = jnp.sum(apart * apart, axis=-1) - (self.radius[self.i] + self.radius[self.j]) ** 2
        size, eps = jnp.max(jnp.abs(path.x)) + jnp.max(self.radius), jnp.finfo(c.dtype).eps
        touching = (c <= 64 * eps * size**2) & (b < -16 * eps * size * length(apart))
        crossing = (b < 0) & (b * b > a * c)
        root_of = jnp.sqrt(jnp.where(crossing, b * b - a * c, 1))
        delay = jnp.where(crossing, c / jnp.where(crossing, root_of - b, 1), jnp.inf)
        s = start + jnp.where(touching, 0, delay)
        return jnp.where((s <= 1) & self.both_alive, s, jnp.inf)

    def first_of_their_balls(self, now: Array, times: Array, first: Array, done: Array) -> Array:
        """The pairs whose meeting is the next impact of both their balls; at a tie, the pair written first."""
        i, j = self.i, self.j
        now = now & (times == first[i]) & (times == first[j]) & ~done[i] & ~done[j]
        rank = jnp.where(now, jnp.arange(len(i)), len(i))
        winner = jnp.full(len(first), len(i)).at[i].min(rank).at[j].min(rank)
        return now & (winner[i] == rank) & (winner[j] == rank)

    def bounce(self, v: Array, normal: Array, recession: Any, restitution: Any) -> tuple[Array, Array]:
        """The change of velocity by an impact, and the part of the tangential velocity that friction leaves."""
        v_n = jnp.sum(v * normal, axis=-1)
        push = -(1 + restitution) * jnp.minimum(v_n + recession, 0)
        v_t = v - v_n[..., None] * normal
        speed = length(v_t)
        held = self.friction * push >= speed
        left = jnp.where(held, 0, 1 - self.friction * push / jnp.where(held, 1, speed))
        return push[..., None] * normal - (1 - left)[..., None] * v_t, left

    def exchange(self, now: Array, x: Array, v: Array, restitution: Any) -> Array:
        """The changes of velocity, (particle, dim), by the impacts of the pairs that meet now; momentum is kept."""
        i, j = self.i, self.j
        change, _ = self.bounce(v[i] - v[j], unit(x[i] - x[j]), 0, restitution)
        return self.share(jnp.where(now[:, None], change, 0))

    def share(self, change: Array) -> Array:
        """A change of x_i - x_j for each pair, (pair, dim), shared between its balls by their inverse masses."""
        w_i, w_j = self.inverse_mass[self.i], self.inverse_mass[self.j]
        total = jnp.where(w_i + w_j > 0, w_i + w_j, 1)
        shared = jnp.zeros((len(self.radius), change.shape[-1]), change.dtype)
        shared = shared.at[self.i].add((w_i / total)[:, None] * change)
        return shared.at[self.j].add(-(w_j / total)[:, None] * change)

    def rest(self, path: Path, v: Array) -> tuple[Array, Array]:
        """Position and velocity at the end of the step; who still overlaps then is put on the surface and stays."""
        end = jnp.ones_like(path.s)
        x = path.x + (end - path.s)[:, None] * path.displacement(self.dt)
        if len(self.i):
            apart = x[self.i] - x[self.j]
            reach = self.radius[self.i] + self.radius[self.j]
            overlap = jnp.where(self.both_alive, reach - length(apart), 0)
            v = v + self.exchange(overlap > 0, x, v, 0)
            x = x + self.share(jnp.maximum(overlap, 0)[:, None] * unit(apart))
        for collider in self.colliders:
            gap = self.gap(collider, end, x)
            on_it = (gap <= self.roundoff(x)) & (self.gap(collider, path.s, path.x) <= self.roundoff(path.x))
            normal, recession = jax.vmap(normal_and_speed, (None, 0, 0))(collider, self.t0 + end * self.dt, x)
            stop, left = self.bounce(v, normal, recession, 0)
            slide = x - path.x
            slide = slide - jnp.sum(slide * normal, axis=-1, keepdims=True) * normal
            under = gap < -self.roundoff(x)  # a bounce that ends with the step is on the surface, and leaves it
            staying = on_it & (jnp.sum(v * normal, axis=-1) + recession <= 0)
            touching = ((under | staying) & (self.inverse_mass > 0))[:, None]
            x = x - jnp.where(touching, gap[:, None] * normal + (1 - left)[:, None] * slide, 0)
            v = v + jnp.where(touching, stop, 0)
        return x, v
