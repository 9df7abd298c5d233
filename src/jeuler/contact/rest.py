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
unknown of each contact. Where the unknowns are few, one step of Newton's method ends it; derivatives are those of the
implicit function theorem on the active set.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from jeuler._core.choice import where
from jeuler._core.vectors import length
from jeuler._jax.anywhere import anywhere
from jeuler._jax.root import root
from jeuler.contact.contacts import Chosen, Contacts
from jeuler.contact.linear import DENSE_UP_TO, ITERATIONS, least_squares, matrix_of, solve_linear

UNSEEN = 1e-2  # of numbers around 1: more than what least squares leave
REST = "contacts at rest"


class Rest(NamedTuple):
    """What the contacts at rest do in a step."""

    kick: Array  # (particle, dim), what they add to the velocity, m/s
    push: Array  # (contact, dim), what each would add along its normal to its partners' relative velocity if alone, m/s
    support: Array  # (particle, dim), the normal part of the kick, and what is carried, m/s
    carried: Array  # (particle, dim), normal forces that the velocities hold already, m/s; no derivative
    rub: Array  # (particle, dim), the friction of the kick, and of what is carried, m/s
    shift: Array  # (particle, dim), by which they close overlaps, m
    on: Array  # (contact,), which of them act
    gap: Array  # (contact,), at the end of the step, where they act, m
    unresolved: Array  # (), int32, how many of them still move into each other


class Problem(NamedTuple):
    """The equations of the contacts at rest."""

    contacts: Contacts | Chosen
    normal: Array  # (contact, dim)
    velocity: Array  # (contact, dim), relative, at the end of the step without contact, m/s
    gap: Array  # (contact,), at the end of the step without contact, over dt, m/s
    theta: Array  # (particle, 1), share of a kick that moves the particle in this step
    active: Array  # (contact,), who touches
    clear: Array  # (contact,), gap at the start, over dt, m/s: what does not touch is not to be pushed into either
    forced: Array  # (), whether a force acts on any particle: without one, all that pushes is a rounding
    fastest: Array  # (), the largest speed of all these velocities, m/s

    @classmethod
    def of(cls, contacts: Contacts | Chosen, normal: Array, velocity: Array, *others: Any) -> Problem:
        gap, theta, active, clear, forced = others
        return cls(contacts, normal, velocity, gap, theta, active, clear, forced, contacts.largest(length(velocity)))

    def push(self, w: Array) -> Array:
        """The normal component of w, (contact,), m/s."""
        return jnp.sum(w * self.normal, axis=-1)

    def project(self, y: Array) -> Array:
        """The impulse nearest to y that pushes, and rubs no more than friction can."""
        y_n = self.push(y)[:, None]
        push = where(self.active[:, None] & (y_n > 0), y_n, 0)
        weak = push <= self.weak()  # which derivative a rounding has is chance: it may be another one if recomputed
        push = where(weak, lax.stop_gradient(push), push)
        y_t = y - y_n * self.normal
        size, most = length(y_t)[:, None], self.contacts.friction * push
        held = size < most  # strictly: friction 0 holds nothing
        rubbed = where(held, y_t, y_t * (most / where(held | (size == 0), 1, size)))
        rubbed = where(weak, lax.stop_gradient(rubbed), rubbed)  # nor does it hold anything
        return push * self.normal + rubbed

    def at_the_limit(self, w: Array) -> Array:
        """Where rounding decides whether friction holds, (contact,): it is at its limit, and nothing slides.

        Among many contacts several forces do the same, and it is not looked for.
        """
        if self.contacts.many:
            return jnp.zeros_like(self.active)
        velocity = self.velocity + self.contacts.relative(self.contacts.move(w))
        most, rub = self.contacts.friction * self.push(w), w - self.push(w)[:, None] * self.normal
        slides = velocity - self.push(velocity)[:, None] * self.normal
        small = 0.1 * self.weak()
        return self.active & (most > self.weak()) & (most - length(rub) <= small) & (length(slides) <= small)

    def weak(self) -> Array:
        """A push, m/s, that may be a rounding, or what the iterations leave."""
        return where(self.forced, 100 * self.relative_tolerance() * self.fastest, jnp.inf)

    def relative_tolerance(self) -> float:
        """How near to the fixed point the iterations come, in parts of the largest velocity of the problem."""
        return max(1e-6 if self.contacts.many else 1e-9, 30 * float(jnp.finfo(self.velocity.dtype).eps))

    def close(self) -> Array:
        """Who touches, or may be pushed into, (contact,)."""
        return self.contacts.close(self.active, self.contacts.dt * self.clear)

    def listed(self) -> tuple[Problem, Array]:
        """The problem of those that are close, where they are few among many, and their numbers here."""
        if isinstance(self.contacts, Chosen):
            return self, jnp.arange(len(self.active))
        contacts, kept = self.contacts.chosen(self.close())
        if contacts is self.contacts:
            return self, kept

        def of(y):
            return y.at[kept].get(mode="fill", fill_value=0)

        own = Problem.of(
            contacts,
            of(self.normal),
            of(self.velocity),
            of(self.gap),
            self.theta,
            of(self.active),
            of(self.clear),
            self.forced,
        )
        return own, kept

    def at_end(self, w: Array, q: Array) -> tuple[Array, Array, Array]:
        """The relative velocity with the impulses w, (contact, dim), the gap over dt without q, and with it."""
        both = self.contacts.move(jnp.concatenate([w, q[:, None] * self.normal], axis=1))
        kick, shift = jnp.split(both, 2, axis=1)
        kick, moved, shift = jnp.split(
            self.contacts.relative(jnp.concatenate([kick, self.theta * kick, shift], axis=1)), 3, axis=1
        )
        gap = where(self.active, self.gap + self.push(moved), self.clear)
        return self.velocity + kick, gap, gap + self.push(shift)

    def better_push(self, w: Array, rate: Array) -> Array:
        """The projection of which the impulses, (contact, dim), are a fixed point."""
        velocity = self.velocity + self.contacts.relative(self.contacts.move(w))
        return self.project(w - rate[:, None] * velocity)

    def better_shift(self, q: Array, rate: Array, small: Array, gap: Array, pressed: Array, close: Array) -> Array:
        """The projection of which the displacements, (contact,), over dt are a fixed point.

        Overlaps are closed, down to ``small``. What presses is drawn together too, each by no more than its own gap, so
        that gaps that cannot all be 0 at once leave it where it is.
        """
        left = gap + self.push(self.contacts.relative(self.contacts.move(q[:, None] * self.normal)))
        lowest = where(pressed, -jnp.maximum(gap, 0), 0)
        return where(close, jnp.maximum(q - rate * (left + where(pressed, 0, small)), lowest), 0)

    def residual(self, u: Array, rate: Array, on: Array, overlap: Array) -> Array:
        """What is 0 at the answer where the gaps ``on`` are closed, down to an overlap; it has derivatives."""
        w, q = u[:, :-1], u[:, -1]
        velocity, _, left = self.at_end(w, q)
        unmoved = w - self.project(w - rate[:, None] * velocity)
        return jnp.concatenate([unmoved, where(on, left + overlap, q)[:, None]], axis=1)


def at_rest(problem: Problem, small: Array, load: Array | None = None, may_open: Array | None = None) -> Rest:
    """The answer of the contacts that are active. Overlaps of ``small``, (contact,), m, are none.

    Where its velocities may hold this answer already, ``load``, (contact, dim), are those that do not: what presses
    under them, and touches at both ends of the step, acts. A surface that gains speed leaves a gap of up to
    ``may_open``, (contact,), m, which is closed.
    """
    own, kept = problem.listed()
    if own is problem:
        return _at_rest(problem, small, load, may_open)

    def of(y):
        return None if y is None else y.at[kept].get(mode="clip")

    rest = _at_rest(own, of(small), of(load), of(may_open))
    without = jnp.sum(problem.close()) - jnp.sum(own.close())
    on = jnp.zeros(len(small), bool).at[kept].set(rest.on, mode="drop")
    gap = jnp.zeros_like(small).at[kept].set(rest.gap, mode="drop")
    push = jnp.zeros_like(problem.normal).at[kept].set(rest.push, mode="drop")
    return rest._replace(push=push, on=on, gap=gap, unresolved=rest.unresolved + without.astype(jnp.int32))


def _at_rest(problem: Problem, small: Array, load: Array | None, may_open: Array | None) -> Rest:
    contacts, active = problem.contacts, problem.active
    small = small / contacts.dt

    stays = unclear = jnp.zeros_like(active)
    held: Array | None = None  # impulses that the velocities hold already
    if load is not None:
        loaded = problem._replace(velocity=load, fastest=contacts.largest(length(load)))
        impulses = loads(loaded, small)
        near = small if may_open is None else may_open / contacts.dt
        stays = (jnp.abs(problem.gap) <= near + problem.weak()) & (loaded.push(impulses) > loaded.weak())
        unclear = loaded.at_the_limit(impulses) | undetermined(loaded, impulses)
        held = lax.stop_gradient(where(stays[:, None], impulses, 0))

    def pressed(w, velocity):  # one of push and parts is 0, or a rounding; or several contacts could hold it
        return lax.stop_gradient(active & (stays | (problem.push(w) > problem.push(velocity) + problem.weak())))

    if contacts.alone:  # each contact for itself: exact at once
        w = problem.project(-problem.velocity)
        gap = problem.gap + problem.push(contacts.relative(problem.theta * contacts.move(w)))
        on = pressed(w, problem.velocity + w) | lax.stop_gradient(active & (gap < -small))
        u = jnp.concatenate([w, where(on, -gap, 0)[:, None]], axis=1)
        unresolved = jnp.sum(unclear | lax.stop_gradient(problem.at_the_limit(w))).astype(jnp.int32)
    else:
        rate = contacts.rate(active)
        start, error = checkpoint_name(_iterate(lax.stop_gradient(problem), small), REST)
        w, q = start[:, :-1], start[:, -1]
        velocity, gap, _ = problem.at_end(w, q)
        presses = pressed(w, velocity)
        on = lax.stop_gradient(presses | ((q > 0) & ((gap < -small) | (q > small) | ~active)))
        overlap = where(presses, 0, small)
        u, unseen = _solve(lambda u: problem.residual(u, rate, on, overlap), start, anywhere(active))
        off = lax.stop_gradient(problem.residual(u, rate, on, overlap))  # Newton's step may have ended it
        off = jnp.minimum(error, jnp.maximum(length(off[:, :-1]) / rate, jnp.abs(off[:, -1])))
        unclear = unclear | (off > _tolerated(problem) + small) | problem.at_the_limit(u[:, :-1])
        unclear = unclear | move_otherwise(contacts, unseen)
        unresolved = jnp.sum(active & lax.stop_gradient(unclear)).astype(jnp.int32)
    w, q = u[:, :-1], u[:, -1]
    _, _, left = problem.at_end(w, q)
    left = where(active, contacts.dt * left, 0)
    held = jnp.zeros_like(w) if held is None else held
    pressing = lax.stop_gradient(problem.push(held)[:, None] * problem.normal)
    push = problem.push(w)[:, None] * problem.normal + pressing
    rub = w + held - push
    moved = contacts.move(jnp.concatenate([w, push, rub, q[:, None] * problem.normal], axis=1))
    kick, support, rub, shift = jnp.split(moved, 4, axis=1)
    carried = lax.stop_gradient(contacts.move(pressing))
    return Rest(kick, push, support, carried, rub, contacts.dt * shift, on, left, unresolved)


def loads(problem: Problem, small: Array) -> Array:
    """The impulses, (contact, dim), of the answer; overlaps of ``small``, over dt, m/s, are none. No derivative."""
    problem = lax.stop_gradient(problem)
    return problem.project(-problem.velocity) if problem.contacts.alone else _impulses(problem, small)[0]


def together(problem: Problem, small: Array) -> tuple[Array, Array]:
    """The kick, m/s, and the shift, m, of the contacts that are active, (particle, dim), without derivative."""
    problem, kept = problem.listed()
    contacts = problem.contacts
    u, _ = _iterate(problem, small.at[kept].get(mode="clip") / contacts.dt)
    return contacts.move(u[:, :-1]), contacts.dt * contacts.move(u[:, -1:] * problem.normal)


def _tolerated(problem: Problem) -> Array:
    """The velocity of a contact, m/s, that counts as none beside those of the problem."""
    speed = length(lax.stop_gradient(problem.velocity))
    rounding = 64 * jnp.finfo(speed.dtype).eps * problem.fastest
    return 1e-3 * problem.contacts.largest(where(problem.active, speed, 0)) + rounding


def _iterate(problem: Problem, small: Array) -> tuple[Array, Array]:
    """The impulses, and in the last column displacements over dt, (contact, dim + 1), without derivative; and how far
    each contact, m/s, is from the fixed points."""
    w, far = _impulses(problem, small)
    _, gap, _ = problem.at_end(w, jnp.zeros_like(small))
    close, pressed = problem.close(), problem.push(w) > 0
    rate = problem.contacts.rate(close)

    def better(q):
        return problem.better_shift(q, rate, small, gap, pressed, close)

    q, off = _accelerated(better, jnp.zeros_like(small), rate, _enough(problem, small), problem.active)
    return jnp.concatenate([w, q[:, None]], axis=1), jnp.maximum(far, off)


def _impulses(problem: Problem, small: Array) -> tuple[Array, Array]:
    """The impulses, (contact, dim), and how far each contact, m/s, is from the fixed point."""
    rate = problem.contacts.rate(problem.active)
    start = jnp.zeros_like(problem.velocity)
    better = functools.partial(problem.better_push, rate=rate)
    return _accelerated(better, start, rate, _enough(problem, small), problem.active)


def _enough(problem: Problem, small: Array) -> Array:
    return problem.relative_tolerance() * problem.fastest + 0.01 * jnp.min(small, initial=jnp.inf)


def _accelerated(
    better: Callable[[Array], Array], start: Array, rate: Array, enough: Array, active: Array
) -> tuple[Array, Array]:
    """The fixed point by accelerated iterations with restarts, and how far each contact, m/s, is from it."""

    def one(state):
        u, ahead, weight, _, k = state
        new = better(ahead)
        restart = jnp.sum((ahead - new) * (new - u)) > 0
        weight = where(restart, 1.0, weight).astype(start.dtype)
        next_weight = (1 + jnp.sqrt(1 + 4 * weight**2)) / 2
        change = new - ahead
        error = (length(change) if change.ndim > 1 else jnp.abs(change)) / rate
        ahead = new + where(restart, 0, (weight - 1) / next_weight) * (new - u)
        return new, ahead, next_weight, error, k + 1

    def go_on(state):
        *_, error, k = state
        return (jnp.max(error, initial=0) > enough) & (k < ITERATIONS)

    error = where(active, jnp.inf, jnp.zeros_like(rate))
    u, _, _, error, _ = lax.while_loop(go_on, one, (start, start, jnp.ones((), start.dtype), error, 0))
    return u, error


def undetermined(problem: Problem, w: Array) -> Array:
    """Which contacts, (contact,), may have other impulses than w by which particles move otherwise."""
    contacts = problem.contacts
    if contacts.alone:
        return jnp.zeros_like(problem.active)
    problem, none = lax.stop_gradient(problem), jnp.zeros_like(problem.gap)
    rate = contacts.rate(problem.active)
    u = jnp.concatenate([w, none[:, None]], axis=1)
    _, unseen = _newton(lambda u: problem.residual(u, rate, none > 0, none), u, anywhere(problem.active))
    return move_otherwise(contacts, unseen)


def move_otherwise(contacts: Contacts | Chosen, unseen: Array) -> Array:
    """Which contacts, (contact,), have a part in what the equations do not see, (contact, dim + 1), if that moves any.

    Where nothing slides, several forces do the same. Where one of them is part of the load of a contact that slides,
    friction there is another one, and with it the motion: which one, the iterations decide.
    """
    moves = jnp.any(length(contacts.move(unseen[:, :-1])) > UNSEEN)
    return moves & (length(unseen[:, :-1]) > UNSEEN)


def _solve(residual: Callable[[Array], Array], guess: Array, needed: Array) -> tuple[Array, Array]:
    """The root of the residual near the guess, and no worse than it; the guess where none is needed. And what `_newton`
    says of others."""

    def tangent_solve(slope, b):
        return lax.cond(needed, lambda b: solve_linear(slope, b), lambda b: b, b)

    return root(residual, guess, functools.partial(_newton, needed=needed), tangent_solve, label=REST)


def _newton(residual: Callable[[Array], Array], guess: Array, needed: Array) -> tuple[Array, Array]:
    """With few unknowns one step of Newton's method, exact if the equations are the right ones and do not contradict
    each other; and what they do not see of a vector of numbers around 1, by which other answers may differ."""
    unseen = jnp.zeros_like(guess)
    if guess.size > DENSE_UP_TO:
        return guess, unseen

    def step(_):
        value, slope = jax.linearize(residual, guess)
        matrix = matrix_of(slope, guess)
        any_one = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, guess.size), guess.dtype)
        change, seen = least_squares(matrix)(jnp.stack([value.ravel(), matrix @ any_one], axis=1)).T
        new = guess - change.reshape(guess.shape)
        rounding = 1e3 * jnp.finfo(guess.dtype).eps * jnp.max(jnp.abs(guess))
        better = jnp.max(jnp.abs(residual(new))) <= 1e-3 * jnp.max(jnp.abs(value)) + rounding
        return where(better, new, guess), (any_one - seen).reshape(guess.shape)

    return lax.cond(needed, step, lambda _: (guess, unseen), None)
