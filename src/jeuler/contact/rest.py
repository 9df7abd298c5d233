"""What touches at the start of a step and stays in touch: the contact forces through the step.

Complementarity on the level of velocities, after J. J. Moreau (1988) and M. Anitescu, F. A. Potra (1997):

    0 <= p_n,   0 <= n.v(end),   p_n n.v(end) = 0,   |p_t| <= friction p_n, against v_t(end)

with v(end) the relative velocity at the end of the step, its forces and all impulses p included. Written as a fixed
point of a projection (P. Alart, A. Curnier, 1991)

    p = proj(p - r v(end)),   proj(y) = y_n^+ n + y_t min(1, friction y_n^+ / |y_t|)

it is iterated with Nesterov's acceleration and restarts (H. Mazhar et al., ACM Transactions on Graphics 34, 2015, who
do so on the friction cone), r the inverse of each contact's response, split among the contacts of a ball (R. Tonge et
al., ACM Transactions on Graphics 31, 2012). The unknowns are changes of velocity w, m/s: what each impulse does to the
relative velocity of its partners if it is alone. Displacements that leave no overlap are a linear system for one more
unknown of each contact. One step of Newton's method on all these equations ends it; derivatives are those of the
implicit function theorem on the active set.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from jeuler._core.vectors import length
from jeuler._jax.anywhere import anywhere
from jeuler._jax.root import root
from jeuler.contact.contacts import Contacts

DENSE_UP_TO = 96  # unknowns; beyond, matrix-free
ITERATIONS = 400
REFINEMENTS = 3
REST = "contacts at rest"


class Rest(NamedTuple):
    """What the contacts at rest do in a step."""

    kick: Array  # (particle, dim), what they add to the velocity, m/s
    shift: Array  # (particle, dim), by which they close overlaps, m
    on: Array  # (contact,), which of them act
    gap: Array  # (contact,), at the end of the step, where they act, m
    unresolved: Array  # (), int32, how many of them still move into each other


class Problem(NamedTuple):
    """The equations of the contacts at rest."""

    contacts: Contacts
    normal: Array  # (contact, dim)
    velocity: Array  # (contact, dim), relative, at the end of the step without contact, m/s
    gap: Array  # (contact,), at the end of the step without contact, over dt, m/s
    theta: Array  # (particle, 1), share of a kick that moves the particle in this step
    active: Array  # (contact,)

    def along(self, y: Array) -> Array:
        """The normal component of the relative y, (contact,), of y (particle, dim)."""
        return jnp.sum(self.contacts.relative(y) * self.normal, axis=-1)

    def push(self, w: Array) -> Array:
        """The normal component of w, (contact,), m/s."""
        return jnp.sum(w * self.normal, axis=-1)

    def project(self, y: Array) -> Array:
        """The impulse nearest to y that pushes, and rubs no more than friction can."""
        y_n = self.push(y)[:, None]
        push = jnp.where(self.active[:, None] & (y_n > 0), y_n, 0)
        y_t = y - y_n * self.normal
        size, most = length(y_t)[:, None], self.contacts.friction * push
        held = size < most  # strictly: friction 0 holds nothing
        return push * self.normal + jnp.where(held, y_t, y_t * (most / jnp.where(held | (size == 0), 1, size)))

    def improve(self, w: Array, kick: Array, rate: Array) -> Array:
        """The projection of which the impulses w, which give the kick, are a fixed point."""
        return self.project(w - rate[:, None] * (self.velocity + self.contacts.relative(kick)))

    def gap_after(self, kick: Array) -> Array:
        return self.gap + self.along(self.theta * kick)

    def shift(self, q: Array) -> Array:
        return self.contacts.move(q[:, None] * self.normal)

    def residual(self, u: Array, rate: Array, on: Array) -> Array:
        """What is to be 0: u holds the w of each contact, and its displacement q over dt."""
        w, q = u[:, :-1], u[:, -1]
        kick = self.contacts.move(w)
        closed = jnp.where(on, self.gap_after(kick) + self.along(self.shift(q)), q)
        return jnp.concatenate([w - self.improve(w, kick, rate), closed[:, None]], axis=1)


def at_rest(problem: Problem, small: Array) -> Rest:
    """The answer of the contacts that are active. Overlaps of ``small``, (contact,), m, are none."""
    contacts, active = problem.contacts, problem.active
    small = small / contacts.dt

    def acting(w, change):  # one of push and parts is 0, or a rounding; or several contacts could hold it
        parts = problem.push(problem.velocity + change)
        weak = 1e-4 * jnp.max(length(problem.velocity), initial=0)
        return lax.stop_gradient(active & (problem.push(w) > parts + weak))

    def overlaps(kick):
        return lax.stop_gradient(active & (problem.gap_after(kick) < -small))

    if len(contacts.colliders) == 1 and not len(contacts.i):  # each particle for itself: exact at once
        w = problem.project(-problem.velocity)
        on, unresolved = acting(w, w) | overlaps(w), jnp.int32(0)
        u = jnp.concatenate([w, jnp.where(on, -problem.gap_after(w), 0)[:, None]], axis=1)
    else:
        rate = 1 / contacts.both(jnp.maximum, _number_of_contacts(contacts, active))
        w, error = checkpoint_name(_iterate(lax.stop_gradient(problem), rate, small), REST)
        unresolved = jnp.sum(active & (error > _tolerated(problem) + small)).astype(jnp.int32)
        kick = contacts.move(w)
        on = acting(w, contacts.relative(kick)) | overlaps(kick)
        u = _solve(lambda u: problem.residual(u, rate, on), jnp.pad(w, ((0, 0), (0, 1))), anywhere(active))
    kick, q = contacts.move(u[:, :-1]), u[:, -1]
    gap = problem.gap_after(kick) + problem.along(problem.shift(q))
    return Rest(kick, contacts.dt * problem.shift(q), on, jnp.where(on, contacts.dt * gap, 0), unresolved)


def _number_of_contacts(contacts: Contacts, active: Array) -> Array:
    one = active.astype(contacts.radius.dtype)
    total = jnp.zeros_like(contacts.radius)
    for k in range(len(contacts.colliders)):
        total = total + one[k * contacts.particles : (k + 1) * contacts.particles]
    if len(contacts.i):
        total = total.at[contacts.i].add(one[contacts.walls :]).at[contacts.j].add(one[contacts.walls :])
    return jnp.maximum(total, 1)


def _tolerated(problem: Problem) -> Array:
    """The velocity of a contact, m/s, that counts as none beside those of the problem."""
    speed = length(lax.stop_gradient(problem.velocity))
    rounding = 64 * jnp.finfo(speed.dtype).eps * jnp.max(speed, initial=0)
    return 1e-3 * jnp.max(jnp.where(problem.active, speed, 0), initial=0) + rounding


def _iterate(problem: Problem, rate: Array, small: Array) -> tuple[Array, Array]:
    """The fixed point by accelerated iterations, and what is left of each contact's velocity; ``small`` is none."""
    velocity = problem.velocity
    enough = jnp.maximum(1e-9, 30 * jnp.finfo(velocity.dtype).eps) * jnp.max(length(velocity), initial=0)
    enough = enough + 0.01 * jnp.min(small, initial=jnp.inf)

    def one(state):
        w, ahead, weight, _, k = state
        new = problem.improve(ahead, problem.contacts.move(ahead), rate)
        restart = jnp.sum((ahead - new) * (new - w)) > 0
        weight = jnp.where(restart, 1.0, weight).astype(velocity.dtype)
        next_weight = (1 + jnp.sqrt(1 + 4 * weight**2)) / 2
        error = length(new - ahead) / rate
        ahead = new + jnp.where(restart, 0, (weight - 1) / next_weight) * (new - w)
        return new, ahead, next_weight, error, k + 1

    def go_on(state):
        *_, error, k = state
        return (jnp.max(error, initial=0) > enough) & (k < ITERATIONS)

    zero = jnp.zeros_like(velocity)
    error = jnp.where(problem.active, jnp.inf, jnp.zeros_like(rate))
    w, _, _, error, _ = lax.while_loop(go_on, one, (zero, zero, jnp.ones((), velocity.dtype), error, 0))
    return w, error


def _solve(residual: Callable[[Array], Array], guess: Array, needed: Array) -> Array:
    """The root of the residual, one step of Newton's method away from the guess; the guess where none is needed."""

    def newton(residual, guess):
        def step(_):
            value, slope = jax.linearize(residual, guess)
            if guess.size > DENSE_UP_TO:  # w is right to the tolerance of the iteration: only the gaps are closed
                value = value.at[:, :-1].set(0)
            return guess - _solve_linear(slope, value)

        return lax.cond(needed, step, lambda _: guess, None), ()

    def tangent_solve(slope, b):
        return lax.cond(needed, lambda b: _solve_linear(slope, b), lambda b: b, b)

    return root(residual, guess, newton, tangent_solve, label=REST)[0]


def _solve_linear(slope: Callable[[Array], Array], b: Array) -> Array:
    """slope^-1 b, by least squares; where contacts are redundant, some forces that do the same."""
    if b.size > DENSE_UP_TO:
        from jax.scipy.sparse.linalg import bicgstab

        return bicgstab(slope, b, tol=1e-9, maxiter=200)[0]
    n = b.size
    matrix = jax.vmap(lambda d: slope(d.reshape(b.shape)).ravel())(jnp.eye(n, dtype=b.dtype)).T
    small = 1e3 * jnp.finfo(b.dtype).eps * jnp.eye(n, dtype=b.dtype)

    def least_squares(m):
        half = lax.linalg.cholesky(m.T @ m + small)

        def solve(_, b):
            def refine(_, x):
                y = (m.T @ (b - m @ x))[:, None]
                y = lax.linalg.triangular_solve(half, y, left_side=True, lower=True)
                return x + lax.linalg.triangular_solve(half, y, left_side=True, lower=True, transpose_a=True)[:, 0]

            return lax.fori_loop(0, 1 + REFINEMENTS, refine, jnp.zeros_like(b))

        return solve

    fixed = lax.stop_gradient(matrix)
    solved = lax.custom_linear_solve(
        lambda d: matrix @ d, b.ravel(), least_squares(fixed), transpose_solve=least_squares(fixed.T)
    )
    return solved.reshape(b.shape)
