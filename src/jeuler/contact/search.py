"""The search for the next impacts: when on their ways through a step particles meet colliders and each other."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core.choice import where
from jeuler._core.vectors import length
from jeuler.contact.contacts import TOUCH, Contacts, Look
from jeuler.contact.paths import Path

MAX_STRIDES = 400  # along one path; one that grazes a surface that is not known to be convex needs many
NEWTON_STEPS = 32  # where the approach begins at 0 each only halves the way to the root
GRAZING = 4  # square roots of a unit in the last place: an approach in parts of the speed that rounding can make or end


class Found(NamedTuple):
    """The next impact of each contact, if it were alone."""

    s: Array  # (contact,), inf for none
    at_root: Array
    plastic: Array
    unclear: Array  # whether the search was given up, or found a path that grazes within rounding: no time of impact
    look: Look  # at s


def rounding_of_speed(contacts: Contacts, path: Path) -> Array:
    """What a speed of approach of 0 may look like, m a step."""
    return contacts.both(jnp.add, 16 * rounding(path))


def rounding(path: Path) -> Array:
    """A unit in the last place of dx/ds and of the coordinates, (particle,), m a step."""
    way, *_ = path.sizes()
    return jnp.finfo(way.dtype).eps * (way + jnp.max(jnp.abs(lax.stop_gradient(path.x)), axis=-1))


def impulsive_limit(contacts: Contacts, normal: Array, path: Path) -> Array:
    """The speed of approach, m a step, up to which an impact is one that the step itself can make: it is plastic.

    By its forces, or by how much the speed of a surface changes in it.

    Among many contacts each partner may be held by others, so that the forces on the other one make it.
    """
    if contacts.many:
        made = contacts.both(jnp.add, length(path.bend))
    else:
        made = jnp.abs(jnp.sum(contacts.relative(path.bend) * normal, axis=-1))
    return 1.001 * (made + contacts.dt * jnp.abs(contacts.gained)) + rounding_of_speed(contacts, path)


def convex_stride(gap: Array, slope: Array, bend: Array) -> Array:
    """How far a gap that would be convex on a straight path is above 0 on one that bends by at most this much.

    The root of  gap + slope h - bend h^2 / 2,  for gap and bend >= 0.
    """
    root = jnp.sqrt(slope**2 + 2 * bend * gap)
    falls = slope < 0
    down = 2 * gap / where(falls, root - slope, 1)
    up = (root + slope) / where(bend > 0, bend, 1)
    return where(falls, down, where(bend > 0, up, 2))


def would_sink(contacts: Contacts, path: Path, look: Look, touching: Array, approaches: Array, still: Array) -> Array:
    """Which contacts, (contact,), touch without an approach and are pressed on, so that they are to be held from now.

    ``still`` is a speed that is none, m a step. Impacts of their partners come first.
    """
    one = approaches.astype(look.gap.dtype)
    busy = contacts.both(jnp.logical_or, contacts.gather(one, -one) > 0)
    pulled = pull(contacts, path, look.normal)
    return touching & (jnp.abs(look.slope) <= still) & (pulled < -2 * still) & ~busy


def pull(contacts: Contacts, path: Path, normal: Array) -> Array:
    """The second derivative of each gap, (contact,), m a step a step, where the normal stays what it is."""
    return jnp.sum(contacts.relative(path.bend) * normal, axis=-1) + contacts.dt * contacts.gained


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
    none = small + where(rests, contacts.open(slow), 0)
    touching = first.gap <= none
    held = jnp.inf if contacts.many else limit
    still = rounding_of_speed(contacts, path) + slow
    approaches = touching & (-first.slope > where(rests, held, still))
    sinks = would_sink(contacts, path, first, touching & ~rests, approaches, still)
    now = approaches | sinks
    lowest = where(now, start - 1, start)
    turn = length(contacts.relative(path.bend))
    fastest = length(first.speed) + turn
    stride = fastest + (jnp.abs(first.recession) + jnp.abs(contacts.gained)) * contacts.dt
    safe_stride = where(stride > 0, stride, 1)
    convex = contacts.convex()
    searched = contacts.possible & (now | (first.gap <= stride))

    def go_on(state):
        s, _, _, newtons, n = state
        return jnp.any(searched & (newtons < NEWTON_STEPS) & (s <= 1)) & (n < MAX_STRIDES)

    def advance(state):
        s, look, apart, newtons, n = state
        gap, slope = look.gap, look.slope
        far = apart & ((gap > 1e-3 * stride) | (slope >= 0)) & (gap > 0) & (newtons == 0)
        longer = convex_stride(jnp.maximum(gap, 0), slope, turn)
        not_too_slow = where(slope >= 0, jnp.minimum(0.02, longer), 0)  # away from a surface of any form
        ahead = jnp.minimum(jnp.maximum(gap / safe_stride, where(convex, longer, not_too_slow)), 2)
        falls = slope < 0
        latest = where(s < 1, jnp.ones_like(s), 2)  # where the gap only begins to fall, Newton's step goes too far
        root = jnp.clip(s - gap / where(falls, slope, -1), lowest, latest)
        s = where(n == 0, s, where(far, s + ahead, where(falls, root, s)))
        newtons = newtons + ((n > 0) & ~far)
        look = contacts.look(path, s)
        newtons = where((newtons > 0) & (jnp.abs(look.gap) <= small / TOUCH), NEWTON_STEPS, newtons)
        apart = where(n == 0, ~now & (look.gap > none), apart)
        return s, look, apart, where(now | apart, newtons, NEWTON_STEPS), n + 1

    begin = where(touching & ~now, start + 1e-3, start)  # who leaves may come back
    state = begin, first, now, jnp.zeros(contacts.count, jnp.int32), 0
    s, look, apart, newtons, _ = lax.while_loop(go_on, advance, state)
    given_up = searched & (newtons < NEWTON_STEPS) & (s <= 1)
    at_root = (look.slope < 0) & (jnp.abs(look.gap) <= small - 1e-6 * look.slope) & (s > lowest)
    at_root = at_root & ~sinks & (~now | (look.slope < 0.5 * first.slope))  # where it began to fall is no impact
    given_up = given_up | (searched & apart & ~at_root & (s <= 1) & (look.gap < -small))
    by_rest = rests & (s - 2 * small / where(at_root, look.slope, -1) >= 1)  # the gap that its solve has closed
    happens = searched & (now | (apart & at_root & (s <= 1) & ~by_rest))
    overlap = now & ~at_root
    look = jax.tree.map(lambda x, y: where(overlap if x.ndim == 1 else overlap[:, None], x, y), first, look)
    s = where(overlap, start, s)
    glancing = GRAZING * jnp.sqrt(jnp.finfo(s.dtype).eps) * length(first.speed)
    grazes = happens & ~now & (-look.slope <= glancing) & (jnp.arange(contacts.count) >= contacts.walls)
    return Found(where(happens, s, jnp.inf), at_root, -look.slope <= limit, given_up | grazes, look)
