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

from jeuler._core.vectors import length, unit
from jeuler._jax.anywhere import anywhere
from jeuler._jax.root import root
from jeuler.contact.contacts import TOUCH, Contacts, Look
from jeuler.contact.paths import Path, along

MAX_STRIDES = 400  # along one path; one that grazes a surface that is not known to be convex needs many
NEWTON_STEPS = 32  # where the approach begins at 0 each only halves the way to the root
GRAZING = 4  # square roots of a unit in the last place: an approach in parts of the speed that rounding can make or end


class Events(NamedTuple):
    """The next impact of each particle, or of each of several rounds."""

    contact: Array  # (particle,), its number, -1 for none
    s: Array  # (particle,)
    at_root: Array  # (particle,), whether the gap is 0 there; in an overlap it is not
    plastic: Array  # (particle,), whether it stays: too slow an approach for restitution


class Found(NamedTuple):
    """The next impact of each contact, if it were alone."""

    s: Array  # (contact,), inf for none
    at_root: Array
    plastic: Array
    unclear: Array  # whether the search was given up, or found a path that grazes within rounding: no time of impact
    look: Look  # at s


def bounce(v: Array, normal: Array, restitution: Any, friction: Any) -> Array:
    """The change of the relative velocity by an impact: Newton's restitution and Coulomb's friction.

    v_n -> -restitution v_n,   |change of v_t| <= friction |change of v_n|,   against v_t
    """
    v_n = jnp.sum(v * normal, axis=-1)
    push = -(1 + restitution) * jnp.where(v_n < 0, v_n, 0)
    v_t = v - v_n[..., None] * normal
    speed = length(v_t)
    held = friction * push > speed  # strictly: friction 0 holds nothing
    lost = jnp.where(held, 1, friction * push / jnp.where(held | (speed == 0), 1, speed))
    return push[..., None] * normal - lost[..., None] * v_t


def rounding_of_speed(contacts: Contacts, path: Path) -> Array:
    """What a speed of approach of 0 may look like, m a step."""
    eps = jnp.finfo(path.x.dtype).eps
    return contacts.both(jnp.add, 4 * eps * (length(path.way) + jnp.max(jnp.abs(path.x), axis=-1)))


def impulsive_limit(contacts: Contacts, normal: Array, path: Path) -> Array:
    """The speed of approach, m a step, up to which an impact is one that the step itself can make: it is plastic.

    Among many contacts each partner may be held by others, so that the forces on the other one make it.
    """
    if contacts.many:
        made = contacts.both(jnp.add, length(path.bend))
    else:
        made = jnp.abs(jnp.sum(contacts.relative(path.bend) * normal, axis=-1))
    return 1.001 * made + rounding_of_speed(contacts, path)


def convex_stride(gap: Array, slope: Array, bend: Array) -> Array:
    """How far a gap that would be convex on a straight path is above 0 on one that bends by at most this much.

    The root of  gap + slope h - bend h^2 / 2,  for gap and bend >= 0.
    """
    root = jnp.sqrt(slope**2 + 2 * bend * gap)
    falls = slope < 0
    down = 2 * gap / jnp.where(falls, root - slope, 1)
    up = (root + slope) / jnp.where(bend > 0, bend, 1)
    return jnp.where(falls, down, jnp.where(bend > 0, up, 2))


def next_impacts(contacts: Contacts, path: Path, slow: Array) -> Found:
    """The next impact of each contact along the paths as they are now.

    Strides of the length of the gap, which cannot cross a surface (J. C. Hart, Sphere tracing, 1996), or longer ones
    where the solid is convex, up to near it; then Newton's method. Who touches and approaches is at an impact now; its
    root is close by, or in the past.
    """
    start = contacts.both(jnp.maximum, path.s)
    small = contacts.roundoff(path.x)
    first = contacts.look(path, start)
    limit = impulsive_limit(contacts, first.normal, path) + slow
    rests = contacts.resting & ~contacts.both(jnp.logical_or, path.hit)  # still as it was held from the start
    none = small + jnp.where(rests, contacts.open(slow), 0)
    touching = first.gap <= none
    held = jnp.inf if contacts.many else limit
    now = touching & (-first.slope > jnp.where(rests, held, rounding_of_speed(contacts, path) + slow))
    lowest = jnp.where(now, start - 1, start)
    turn = length(contacts.relative(path.bend))
    fastest = length(first.speed) + turn
    stride = fastest + jnp.abs(first.recession) * contacts.dt
    safe_stride = jnp.where(stride > 0, stride, 1)
    convex = contacts.convex()
    searched = contacts.possible() & (now | (first.gap <= stride))

    def go_on(state):
        s, _, _, newtons, n = state
        return jnp.any(searched & (newtons < NEWTON_STEPS) & (s <= 1)) & (n < MAX_STRIDES)

    def advance(state):
        s, look, apart, newtons, n = state
        gap, slope = look.gap, look.slope
        far = apart & ((gap > 1e-3 * stride) | (slope >= 0)) & (gap > 0) & (newtons == 0)
        longer = convex_stride(jnp.maximum(gap, 0), slope, turn)
        not_too_slow = jnp.where(slope >= 0, jnp.minimum(0.02, longer), 0)  # away from a surface of any form
        ahead = jnp.minimum(jnp.maximum(gap / safe_stride, jnp.where(convex, longer, not_too_slow)), 2)
        falls = slope < 0
        latest = jnp.where(s < 1, 1, 2)  # where the gap only begins to fall, Newton's step goes too far
        root = jnp.clip(s - gap / jnp.where(falls, slope, -1), lowest, latest)
        s = jnp.where(n == 0, s, jnp.where(far, s + ahead, jnp.where(falls, root, s)))
        newtons = newtons + jnp.where((n > 0) & ~far, 1, 0)
        look = contacts.look(path, s)
        newtons = jnp.where((newtons > 0) & (jnp.abs(look.gap) <= small / TOUCH), NEWTON_STEPS, newtons)
        apart = jnp.where(n == 0, ~now & (look.gap > none), apart)
        return s, look, apart, jnp.where(now | apart, newtons, NEWTON_STEPS), n + 1

    begin = start + jnp.where(touching & ~now, 1e-3, 0)  # who leaves may come back
    state = begin, first, now, jnp.zeros(contacts.count, jnp.int32), 0
    s, look, apart, newtons, _ = lax.while_loop(go_on, advance, state)
    given_up = searched & (newtons < NEWTON_STEPS) & (s <= 1)
    at_root = (look.slope < 0) & (jnp.abs(look.gap) <= small - 1e-6 * look.slope) & (s > lowest)
    given_up = given_up | (searched & apart & ~at_root & (s <= 1) & (look.gap < -small))
    by_rest = rests & (s - 2 * small / jnp.where(at_root, look.slope, -1) >= 1)  # the gap that its solve has closed
    happens = searched & (now | (apart & at_root & (s <= 1) & ~by_rest))
    overlap = now & ~at_root
    look = jax.tree.map(lambda x, y: jnp.where(overlap if x.ndim == 1 else overlap[:, None], x, y), first, look)
    s = jnp.where(overlap, start, s)
    glancing = GRAZING * jnp.sqrt(jnp.finfo(s.dtype).eps) * length(first.speed)
    grazes = happens & ~now & (-look.slope <= glancing) & (jnp.arange(contacts.count) >= contacts.walls)
    return Found(jnp.where(happens, s, jnp.inf), at_root, -look.slope <= limit, given_up | grazes, look)


def choose(contacts: Contacts, found: Found) -> Events:
    """The impacts of this round: those that come first among all those of their particles and neighbours."""
    n, numbers = contacts.particles, jnp.arange(contacts.count)
    i, j, pairs = contacts.i, contacts.j, slice(contacts.walls, None)

    def least(per_contact, initial):
        value = jnp.min(per_contact[: contacts.walls].reshape(-1, n), axis=0, initial=initial)
        return value.at[i].min(per_contact[pairs]).at[j].min(per_contact[pairs]) if len(i) else value

    first = least(found.s, jnp.inf)
    if len(i):
        between = jnp.where(contacts.listed, jnp.minimum(first[i], first[j]), jnp.inf)
        first = first.at[i].min(between).at[j].min(between)
    now = jnp.isfinite(found.s) & (found.s <= contacts.both(jnp.minimum, first))
    rank = jnp.where(now, numbers, contacts.count)
    winner = least(rank, contacts.count)
    chosen = jnp.where(winner < contacts.walls, winner, contacts.count)
    if len(i):  # a pair goes on only if it is the first of both
        agreed = now[pairs] & (winner[i] == rank[pairs]) & (winner[j] == rank[pairs])
        number = jnp.where(agreed, rank[pairs], contacts.count)
        chosen = chosen.at[i].min(number).at[j].min(number)
    there = chosen < contacts.count
    of = jnp.where(there, chosen, 0)
    contact = jnp.where(there, chosen, -1).astype(jnp.int32)
    return Events(contact, jnp.where(there, found.s[of], 0), there & found.at_root[of], there & found.plastic[of])


def meet(contacts: Contacts, path: Path, events: Events) -> tuple[Array, Look]:
    """The time of each contact's impact as a function of the paths, and the contact's geometry then.

    gap(path, s) = 0,   in an overlap s is that of the later last impact of its partners
    """
    start = contacts.both(jnp.maximum, path.s)
    at_root = met(contacts, events) & contacts.first(events.at_root)

    def gap(s):
        return jnp.where(at_root, contacts.look(path, s).gap, s - start)

    known = jnp.where(at_root, contacts.first(events.s), start)
    s, _ = root(gap, known, lambda _, s: (s, ()), lambda slope, b: b / slope(jnp.ones_like(b)))
    return s, contacts.look(path, s)


def met(contacts: Contacts, events: Events) -> Array:
    """Which contacts have their impact in this round."""
    return contacts.first(events.contact) == jnp.arange(contacts.count)


def strike(contacts: Contacts, path: Path, events: Events, s: Array, look: Look, theta: Array) -> Path:
    """The paths after the impacts of one round, each at its s, (contact,)."""
    now, plastic = met(contacts, events), contacts.first(events.plastic)
    normal, bend = look.normal, contacts.relative(path.bend)
    v = look.speed / contacts.dt + look.recession[:, None] * normal
    change = bounce(v, normal, jnp.where(plastic, 0, contacts.restitution), contacts.friction)
    into = jnp.sum(bend * normal, axis=-1)
    stays = plastic & (into < rounding_of_speed(contacts, path))  # without a push too, as where a solve holds it
    held = jnp.where(stays, -into, 0)[:, None] * normal  # no more push into what it stays on

    zero = jnp.zeros_like(change)
    kick = contacts.move(jnp.where(now[:, None], change, zero))
    hold = shared(contacts, path, normal, jnp.where(now[:, None], held, zero))
    own_s = spread(contacts, path.s, s, now)
    hit = (events.contact >= 0)[:, None]
    late = (1 - own_s)[:, None] + 0.5 - theta
    speed = jnp.where(hit, path.speed(own_s) + contacts.dt * kick, path.way)
    off = hit & leaves_its_support(path, own_s, speed)
    hold = hold - jnp.where(off, path.support, 0)
    support = path.support + hold
    new = jnp.abs(along(hold, support)) > 1e-6 * (length(path.bend) + length(path.support))
    return Path(
        own_s,
        jnp.where(hit, path.position(own_s), path.x),
        speed,
        path.bend + hold,
        path.jump + kick + late * hold / contacts.dt,
        path.hit | hit[:, 0],
        support,
        jnp.where(new, along(speed, support), path.ride),
        jnp.where(off, 0, path.ground) + contacts.of_colliders(jnp.where(now[:, None], held, zero)),
    )


def shared(contacts: Contacts, path: Path, normal: Array, change: Array) -> Array:
    """What of a change of the relative bend along the normal, (contact, dim), falls to each particle, (particle, dim).

    By the masses; who is pushed against colliders that hold it moves along these, which take the rest of the push. Who
    is pushed against balls that hold it, and no collider, stays, and the other partner takes all.
    """
    if contacts.alone:
        return contacts.gather(change, change)
    least = 1e-6 * (length(path.bend) + length(path.support))  # of a push; what is less is left by iterations
    colliders = [unit(jnp.where((length(ground) > least)[:, None], ground, 0)) for ground in path.ground]
    on_balls = length(path.support) > least
    for upward in colliders:
        on_balls = on_balls & jnp.all(upward == 0, axis=-1)

    def response(of, towards):
        """What a push of 1 along ``towards`` does to a particle, (contact, dim)."""
        push = towards
        for upward in [of(up) for up in (*colliders, *colliders[:-1])]:
            push = push - jnp.minimum(jnp.sum(upward * push, axis=-1, keepdims=True), 0) * upward
        support = of(path.support)
        stays = of(on_balls) & (jnp.sum(support * towards, axis=-1) < -0.5 * length(support))
        return jnp.where(stays[:, None], 0, push * of(contacts.inverse_mass)[:, None])

    first, second = response(contacts.first, normal), response(contacts.second, -normal)
    both = jnp.sum((first - second) * normal, axis=-1, keepdims=True)
    moves = both > 1e-6 * contacts.both(jnp.add, contacts.inverse_mass)[:, None]
    push = jnp.sum(change * normal, axis=-1, keepdims=True) * jnp.where(moves, 1 / jnp.where(moves, both, 1), 0)
    return contacts.gather(push * first, -push * second)


def leaves_its_support(path: Path, s: Array, speed: Array) -> Array:
    """Whether a particle with this dx/ds at s goes off what held it and does not fall back in this step."""
    excess, rounding = off_its_support(path, s, speed)
    return (excess > rounding)[:, None]


def off_its_support(path: Path, s: Array, speed: Array) -> tuple[Array, Array]:
    """By how much dx/ds, m a step, is more than what falls back in this step; and what of that may be rounding."""
    falls_back = 0.5 * (1 - s) * length(path.support)
    rounding = 16 * jnp.finfo(s.dtype).eps * (length(path.way) + jnp.max(jnp.abs(path.x), axis=-1))
    return along(speed, path.support) - path.ride - falls_back, rounding


def spread(contacts: Contacts, y: Array, per_contact: Array, met: Array) -> Array:
    """y with the value of its contact for each particle that met one."""
    n = contacts.particles
    for k in range(len(contacts.colliders)):
        own = slice(k * n, (k + 1) * n)
        y = jnp.where(met[own], per_contact[own], y)
    if len(contacts.i):
        pairs = per_contact[contacts.walls :]
        for body in (contacts.i, contacts.j):
            y = y.at[jnp.where(met[contacts.walls :], body, n)].set(pairs, mode="drop")
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
    if contacts.alone:
        return jnp.int32(0)
    orders, leaves = of_an_order(contacts, path, after, events, found), may_leave(path, after, events)
    return (jnp.sum(orders) + jnp.sum(leaves) + jnp.sum(may_stick(contacts, events, found))).astype(jnp.int32)


def of_an_order(contacts: Contacts, path: Path, after: Path, events: Events, found: Found) -> Array:
    """Which impacts, (contact,), that were not chosen are at the same time, within rounding, as one of their partners'
    that was chosen, and another one after it: what happens depends on an order that rounding decides."""
    look, chosen = found.look, events.contact >= 0
    earliest = contacts.both(jnp.minimum, jnp.where(chosen, events.s, jnp.inf))
    small = 2 * contacts.roundoff(path.x) / jnp.where(look.slope < 0, -look.slope, jnp.inf)
    together = jnp.isfinite(found.s) & (found.s <= earliest + small) & ~met(contacts, events)
    change = contacts.relative(after.jump - path.jump)
    into = jnp.sum(change * look.normal, axis=-1)
    along = length(change - into[:, None] * look.normal)
    curved = contacts.curved()  # the speed along a curved surface is one into it from beside
    of_chosen = contacts.both(jnp.logical_or, chosen & curved[events.contact])
    noticed = jnp.abs(into) + jnp.where((contacts.friction > 0) | curved | of_chosen, along, 0)
    walls = jnp.arange(contacts.count) < contacts.walls
    same = walls & contacts.first(chosen & (events.contact < contacts.walls))  # of two flush surfaces the order is one
    same = same & (jnp.sum(contacts.first(look.normal[events.contact]) * look.normal, axis=-1) > 1 - 1e-4)
    return together & ~same & (noticed * contacts.dt > 1e-3 * length(look.speed))


def may_leave(path: Path, after: Path, events: Events) -> Array:
    """Which particles, (particle,), an impact takes off what held them or not, as rounding decides."""
    excess, rounding = off_its_support(path, after.s, after.way)
    moved = jnp.abs(along(after.way, path.support) - path.ride)
    return (events.contact >= 0) & (jnp.abs(excess) <= 4 * rounding) & (moved > 1e-3 * length(path.support))


def by_chance(contacts: Contacts, path: Path, events: Events, slow: Array) -> Array:
    """Which contacts, (contact,), the impacts of a step leave touching without a load or a motion against each other.

    Not those whose own plastic impact makes them so: whether the others part or press from then on, rounding decides.
    """
    end = contacts.look(path, jnp.ones_like(slow))
    touches = (end.gap <= contacts.roundoff(path.x) + contacts.open(slow)) & contacts.possible()
    still = jnp.abs(end.slope) <= slow + rounding_of_speed(contacts, path)
    number = jnp.arange(len(events.contact))[:, None]
    last = jnp.argmax(jnp.where(events.contact >= 0, number, -1), axis=0)
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
    restitution = jnp.where(contacts.first(events.plastic), 0, contacts.restitution)
    most = contacts.friction * (1 + restitution) * jnp.abs(v_n)
    return met(contacts, events) & (jnp.abs(most - along) <= 1e3 * jnp.finfo(along.dtype).eps * most) & (most > 0)


def go_through(contacts: Contacts, path: Path, events: Events, theta: Array) -> Path:
    """The paths after all rounds of a schedule, differentiable; rounds without an impact cost nothing."""

    recomputed = functools.partial(jax.checkpoint, prevent_cse=False)

    @recomputed
    def again(path, events):
        return strike(contacts, path, events, *meet(contacts, path, events), theta)

    @recomputed
    def one(path, events):
        happens = anywhere(events.contact >= 0)
        return lax.cond(happens, again, lambda path, _: path, path, events), None

    return lax.scan(one, path, events)[0]
