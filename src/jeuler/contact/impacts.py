"""Impacts: when on its way through a step a particle meets a collider or another ball, and what it does to it.

The search for the impacts is not differentiated. It writes a schedule: who meets what in which round. The rounds are
then gone through again, with the time of each impact as a function of the paths.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core.choice import where
from jeuler._core.vectors import direction, length, total
from jeuler._jax.anywhere import anywhere
from jeuler._jax.root import root
from jeuler.contact.contacts import Contacts, Look
from jeuler.contact.partners import least, put, rows
from jeuler.contact.paths import Path, along
from jeuler.contact.search import Found, next_impacts, pull, rounding, rounding_of_speed

AT_ONCE = 32  # rounds that are skipped together where none of them has an impact
ENOUGH = 0.1  # of a push: the support that holds against it
WEDGE = 1e-2  # of the response of free partners: one that is less would have to go far for a small push


class Events(NamedTuple):
    """The next impact of each particle, or of each of several rounds."""

    contact: Array  # (particle,), its number, -1 for none
    s: Array  # (particle,)
    at_root: Array  # (particle,), whether the gap is 0 there; in an overlap it is not
    plastic: Array  # (particle,), whether it stays: too slow an approach for restitution


def bounce(v: Array, normal: Array, restitution: Any, friction: Any) -> Array:
    """The change of the relative velocity by an impact: Newton's restitution and Coulomb's friction.

    v_n -> -restitution v_n,   |change of v_t| <= friction |change of v_n|,   against v_t
    """
    v_n = jnp.sum(v * normal, axis=-1)
    push = -(1 + restitution) * where(v_n < 0, v_n, 0)
    v_t = v - v_n[..., None] * normal
    speed = length(v_t)
    held = friction * push > speed  # strictly: friction 0 holds nothing
    lost = where(held, 1, friction * push / where(held | (speed == 0), 1, speed))
    return push[..., None] * normal - lost[..., None] * v_t


def choose(contacts: Contacts, found: Found) -> Events:
    """The impacts of this round: those that come first among all those of their particles and neighbours."""
    n, numbers = contacts.particles, jnp.arange(contacts.count)
    i, j, pairs = contacts.i, contacts.j, slice(contacts.walls, None)

    def at_both(value, of_pairs):
        return least(least(value, i, of_pairs), j, of_pairs)

    def earliest(per_contact, initial):
        value = jnp.min(per_contact[: contacts.walls].reshape(-1, n), axis=0, initial=initial)
        return at_both(value, per_contact[pairs]) if len(i) else value

    first = earliest(found.s, jnp.inf)
    if len(i):
        first = at_both(first, where(contacts.listed, jnp.minimum(rows(first, i), rows(first, j)), jnp.inf))
    now = jnp.isfinite(found.s) & (found.s <= contacts.both(jnp.minimum, first))
    rank = where(now, numbers, contacts.count)
    winner = earliest(rank, contacts.count)
    chosen = where(winner < contacts.walls, winner, contacts.count)
    if len(i):  # a pair goes on only if it is the first of both
        agreed = now[pairs] & (rows(winner, i) == rank[pairs]) & (rows(winner, j) == rank[pairs])
        chosen = at_both(chosen, where(agreed, rank[pairs], contacts.count))
    there = chosen < contacts.count
    of = where(there, chosen, 0)
    contact = where(there, chosen, -1).astype(jnp.int32)
    s, at_root, plastic = (rows(y, of) for y in (found.s, found.at_root, found.plastic))
    return Events(contact, where(there, s, 0), there & at_root, there & plastic)


def meet(contacts: Contacts, path: Path, events: Events) -> tuple[Array, Look]:
    """The time of each contact's impact as a function of the paths, and the contact's geometry then.

    gap(path, s) = 0,   in an overlap s is that of the later last impact of its partners
    """
    start = contacts.both(jnp.maximum, path.s)
    at_root = met(contacts, events) & contacts.first(events.at_root)

    def gap(s):
        return where(at_root, contacts.gap(path, s), s - start)

    known = where(at_root, contacts.first(events.s), start)
    s, _ = root(gap, known, lambda _, s: (s, ()), lambda slope, b: b / slope(jnp.ones_like(b)))
    return s, contacts.look(path, s)


def met(contacts: Contacts, events: Events) -> Array:
    """Which contacts have their impact in this round."""
    return contacts.first(events.contact) == jnp.arange(contacts.count)


def strike(contacts: Contacts, path: Path, events: Events, s: Array, look: Look, theta: Array) -> Path:
    """The paths after the impacts of one round, each at its s, (contact,)."""
    now, plastic = met(contacts, events), contacts.first(events.plastic)
    normal = look.normal
    v = look.speed / contacts.dt + look.recession[:, None] * normal
    change = bounce(v, normal, where(plastic, 0, contacts.restitution), contacts.friction)
    into = pull(contacts, path, normal)
    stays = plastic & (into < rounding_of_speed(contacts, path))  # without a push too, as where a solve holds it
    held = where(stays, -into, 0)[:, None] * normal  # no more push into what it stays on

    zero = jnp.zeros_like(change)
    kick = contacts.move(where(now[:, None], change, zero))
    hold = shared(contacts, path, normal, where(now[:, None], held, zero))
    own_s = spread(contacts, path.s, s, now)
    hit = (events.contact >= 0)[:, None]
    late = (1 - own_s)[:, None] + 0.5 - theta
    speed = where(hit, path.speed(own_s) + contacts.dt * kick, path.way)
    off = hit & leaves_its_support(path, own_s, speed)
    hold = hold - where(off, path.support, 0)
    support, turned = path.support + hold, hit & drives(path, own_s, speed)
    hold = hold - where(turned, path.rub, 0)
    new = jnp.abs(along(hold, support)) > path.least()
    return Path(
        own_s,
        where(hit, path.position(own_s), path.x),
        speed,
        path.bend + hold,
        path.jump + kick + late * hold / contacts.dt,
        path.hit | hit[:, 0],
        support,
        where(new, along(speed, support), path.ride),
        where(turned, 0, path.rub),
        where(off, 0, path.ground) + contacts.of_colliders(where(now[:, None], held, zero)),
    )


def shared(contacts: Contacts, path: Path, normal: Array, change: Array) -> Array:
    """What of a change of the relative bend along the normal, (contact, dim), falls to each particle, (particle, dim).

    By the masses; who is pushed against colliders that hold it moves along these, which take the rest of the push. Who
    is pushed against balls that hold it, by a force of the push's order and no collider, stays, and the other partner
    takes all. Nobody moves where a wedge would have to go far.
    """
    if contacts.alone:
        return contacts.move(change)
    _, _, support = path.sizes()
    least = path.least()
    size, upward = direction(path.ground)
    upward = where(size > least[:, None], upward, 0)
    on_balls = (support > least) & ~jnp.any(upward != 0, axis=(0, 2))
    towards = jnp.stack([normal, -normal])

    def of(y):
        return jnp.stack([contacts.first(y), contacts.second(y)])

    response = towards  # what a push of 1 along these does to each partner, (2, contact, dim)
    colliders = [of(up) for up in upward]
    for up in (*colliders, *colliders[:-1]):
        response = response - jnp.minimum(jnp.sum(up * response, axis=-1, keepdims=True), 0) * up
    push = jnp.sum(change * normal, axis=-1, keepdims=True)
    holds = of(support) > ENOUGH * jnp.abs(lax.stop_gradient(push[:, 0]))
    stays = of(on_balls) & holds & (jnp.sum(of(path.support) * towards, axis=-1) < -0.5 * of(support))
    first, second = where(stays[..., None], 0, response * of(contacts.inverse_mass)[..., None])
    both = jnp.sum((first - second) * normal, axis=-1, keepdims=True)
    moves = both > WEDGE * contacts.both(jnp.add, contacts.inverse_mass)[:, None]
    push = push * where(moves, 1 / where(moves, both, 1), 0)
    return contacts.gather(push * first, -push * second)


def drives(path: Path, s: Array, speed: Array) -> Array:
    """Whether the friction of what a particle stays on, which has held its dx/ds back, would drive it from s on."""
    rubs = length(lax.stop_gradient(path.rub)) > path.least()
    before, after = along(path.speed(s), path.rub), along(speed, path.rub)
    return (rubs & (before <= 0) & (after > 0))[:, None]


def leaves_its_support(path: Path, s: Array, speed: Array) -> Array:
    """Whether a particle with this dx/ds at s goes off what held it and does not fall back in this step."""
    excess, small = off_its_support(path, s, speed)
    return (excess > small)[:, None]


def off_its_support(path: Path, s: Array, speed: Array) -> tuple[Array, Array]:
    """By how much dx/ds, m a step, is more than what falls back in this step; and what of that may be rounding."""
    _, _, support = path.sizes()
    falls_back = 0.5 * (1 - s) * support
    return along(speed, path.support) - path.ride - falls_back, 16 * rounding(path)


def spread(contacts: Contacts, y: Array, per_contact: Array, met: Array) -> Array:
    """y with the value of its contact for each particle that met one."""
    n = contacts.particles
    for k in range(len(contacts.colliders)):
        own = slice(k * n, (k + 1) * n)
        y = where(met[own], per_contact[own], y)
    if len(contacts.i):
        for body in (contacts.i, contacts.j):
            y = put(y, body, per_contact[contacts.walls :], met[contacts.walls :])
    return y


def schedule(
    contacts: Contacts, path: Path, slow: Array, theta: Array, rounds: int
) -> tuple[Events, Path, Array, Array]:
    """The impacts of all rounds and of one more, which rest, each leaf (round, particle); the paths after them; and the
    numbers of impacts that were made to rest, and of those whose outcome rounding decides."""
    none = jnp.full(contacts.particles, -1, jnp.int32)
    no = jnp.zeros(contacts.particles, bool)
    empty = Events(none, jnp.zeros_like(path.s), no, no)
    record = jax.tree.map(lambda x: jnp.broadcast_to(x, (rounds + 1, *x.shape)), empty)

    def play(path, found, k):
        events = choose(contacts, found)
        events = events._replace(plastic=events.plastic | (k == rounds))
        after = strike(contacts, path, events, found.s, found.look, theta)
        return after, events, undecided(contacts, path, after, events, found)

    def one(state):
        path, record, k, _, left, unsure = state
        found = next_impacts(contacts, path, slow)
        happens = jnp.isfinite(found.s)
        stopped = (k == rounds) & happens & ~found.plastic
        left = left + jnp.sum(found.unclear | stopped).astype(jnp.int32)
        path, events, more = lax.cond(
            anywhere(happens), play, lambda path, *_: (path, empty, jnp.int32(0)), path, found, k
        )
        record = jax.tree.map(lambda all_, x: all_.at[k].set(x, mode="drop"), record, events)
        return path, record, k + 1, jnp.any(happens), left, unsure + more

    def go_on(state):
        _, _, k, any_left, *_ = state
        return any_left & (k <= rounds)

    start = path, record, jnp.int32(0), jnp.asarray(True), jnp.int32(0), jnp.int32(0)
    path, record, _, _, left, unsure = lax.while_loop(go_on, one, start)
    return record, path, left, unsure


def undecided(contacts: Contacts, path: Path, after: Path, events: Events, found: Found) -> Array:
    """How many impacts of a round have an outcome that rounding decides, (), int32."""
    which = [may_stick(contacts, events, found)]
    if not contacts.alone:
        which += [of_an_order(contacts, path, after, events, found), may_leave(path, after, events)]
    return total(jnp.sum(of_each) for of_each in which).astype(jnp.int32)


def of_an_order(contacts: Contacts, path: Path, after: Path, events: Events, found: Found) -> Array:
    """Which impacts, (contact,), that were not chosen are at the same time, within rounding, as one of their partners'
    that was chosen, and another one after it: what happens depends on an order that rounding decides."""
    look, chosen = found.look, events.contact >= 0
    earliest = contacts.both(jnp.minimum, where(chosen, events.s, jnp.inf))
    small = 2 * contacts.roundoff(path.x) / where(look.slope < 0, -look.slope, jnp.inf)
    together = jnp.isfinite(found.s) & (found.s <= earliest + small) & ~met(contacts, events)
    change = contacts.relative(after.jump - path.jump)
    into = jnp.sum(change * look.normal, axis=-1)
    along = length(change - into[:, None] * look.normal)
    curved = contacts.curved()  # the speed along a curved surface is one into it from beside
    of_chosen = contacts.both(jnp.logical_or, chosen & curved[events.contact])
    noticed = jnp.abs(into) + where((contacts.friction > 0) | curved | of_chosen, along, 0)
    walls = jnp.arange(contacts.count) < contacts.walls
    same = walls & contacts.first(chosen & (events.contact < contacts.walls))  # of two flush surfaces the order is one
    same = same & (jnp.sum(contacts.first(look.normal[events.contact]) * look.normal, axis=-1) > 1 - 1e-4)
    return together & ~same & (noticed * contacts.dt > 1e-3 * length(look.speed))


def may_leave(path: Path, after: Path, events: Events) -> Array:
    """Which particles, (particle,), an impact takes off what held them or not, as rounding decides."""
    excess, small = off_its_support(path, after.s, after.way)
    moved = jnp.abs(along(after.way, path.support) - path.ride)
    return (events.contact >= 0) & (jnp.abs(excess) <= 4 * small) & (moved > 1e-3 * length(path.support))


def by_chance(contacts: Contacts, path: Path, events: Events, end: Look, slow: Array) -> Array:
    """Which contacts, (contact,), the impacts of a step leave touching without a load or a motion against each other.

    Not those whose own plastic impact makes them so: whether the others part or press from then on, rounding decides.
    """
    touches = (end.gap <= contacts.roundoff(path.x) + contacts.open(slow)) & contacts.possible
    still = jnp.abs(end.slope) <= slow + rounding_of_speed(contacts, path)
    number = jnp.arange(len(events.contact))[:, None]
    last = jnp.argmax(where(events.contact >= 0, number, -1), axis=0)
    contact, plastic = (jnp.take_along_axis(y, last[None], axis=0)[0] for y in (events.contact, events.plastic))
    numbers = jnp.arange(contacts.count)
    own = (contacts.both(jnp.minimum, contact) == numbers) & (contacts.both(jnp.maximum, contact) == numbers)
    made = own & ((contacts.restitution == 0) | contacts.first(plastic))
    loaded = contacts.both(jnp.logical_or, jnp.any(path.support != 0, axis=-1))
    forced = contacts.both(jnp.logical_or, jnp.any(path.bend != 0, axis=-1))
    return touches & still & contacts.both(jnp.logical_or, path.hit) & forced & ~made & ~loaded


def may_stick(contacts: Contacts, events: Events, found: Found) -> Array:
    """Which impacts, (contact,), friction stops along the surface or not, as rounding decides."""
    v, normal = found.look.speed / contacts.dt, found.look.normal
    v_n = jnp.sum(v * normal, axis=-1) + found.look.recession
    along = length(v - jnp.sum(v * normal, axis=-1)[:, None] * normal)
    restitution = where(contacts.first(events.plastic), 0, contacts.restitution)
    most = contacts.friction * (1 + restitution) * jnp.abs(v_n)
    return met(contacts, events) & (jnp.abs(most - along) <= 1e3 * jnp.finfo(along.dtype).eps * most) & (most > 0)


def go_through(contacts: Contacts, path: Path, events: Events, theta: Array) -> Path:
    """The paths after all rounds of a schedule, differentiable; rounds without an impact cost nothing."""

    recomputed = functools.partial(jax.checkpoint, prevent_cse=False)

    @recomputed
    def again(path, events):
        return strike(contacts, path, events, *meet(contacts, path, events), theta)

    def where_any(happens, path, events):
        return lax.cond(anywhere(events.contact >= 0), happens, lambda path, _: path, path, events), None

    one = recomputed(functools.partial(where_any, again))

    def some(path, events):
        return where_any(lambda path, events: lax.scan(one, path, events)[0], path, events)

    rounds = len(events.contact)
    at_once = min(rounds, AT_ONCE)
    none = jax.tree.map(lambda x: jnp.zeros((-rounds % at_once, *x.shape[1:]), x.dtype), events)
    none = none._replace(contact=none.contact - 1)
    several = jax.tree.map(lambda x, y: jnp.concatenate([x, y]).reshape(-1, at_once, *x.shape[1:]), events, none)
    return lax.scan(some, path, several)[0]
