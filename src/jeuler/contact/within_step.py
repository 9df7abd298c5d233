"""One step with contact: forces of what rests, then impacts at their times."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from jeuler._core.choice import where
from jeuler._core.vectors import length, unit
from jeuler._jax.anywhere import where_needed
from jeuler._jax.found import found, found_p
from jeuler.contact.colliders import moves
from jeuler.contact.contacts import Contacts, Look
from jeuler.contact.impacts import by_chance, go_through, schedule
from jeuler.contact.partners import most
from jeuler.contact.paths import Path, free_path, share_of_the_force
from jeuler.contact.rest import REST, Problem, at_rest, together
from jeuler.contact.search import impulsive_limit

IMPACTS = "impacts"  # the name of what the search of a step has found
DECIDED = "decided"  # and of what is decided before it, without a derivative


def _kept(primitive: Any, *_: Any, name: str = "", label: str = "", **__: Any) -> bool:
    """What reverse mode keeps of a step: the results of searches and solves; it recomputes the rest."""
    return name in (IMPACTS, REST, DECIDED) or label == REST or primitive is found_p


def decided(x: Array) -> Array:
    """x, without a derivative, and kept for reverse mode."""
    return checkpoint_name(lax.stop_gradient(x), DECIDED)


@functools.partial(jax.jit, static_argnames="rounds")
def resolve(
    contacts: Contacts,
    x: Array,
    v: Array,
    x_free: Array,
    v_free: Array,
    rounds: int,
    acceleration: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Position and velocity at the end of a step that led from (x, v) to (x_free, v_free), and what it left undone.

    A step that may have solved for its end with the forces of what rests says the acceleration, (particle, dim), at its
    start without them: by it is known what presses.
    """
    load = None if acceleration is None else v + contacts.dt * acceleration
    step = functools.partial(_resolve, rounds=rounds, load=load)
    return jax.checkpoint(step, prevent_cse=False, policy=_kept)(contacts, x, v, x_free, v_free)


def _resolve(
    contacts: Contacts, x: Array, v: Array, x_free: Array, v_free: Array, rounds: int, load: Array | None
) -> tuple[Array, Array, Array]:
    displacement, dv = x_free - x, v_free - v
    theta = decided(share_of_the_force(x, displacement, v, dv, contacts.dt, contacts.total))
    free = free_path(x, displacement, dv, contacts.dt)
    contacts.near(free)
    contacts.gained, receded = motion_of_surfaces(contacts, free)
    slow = _slow(contacts, dv)

    path, v_end, touched, unresolved, lost = hold(contacts, x, v, displacement, dv, theta, slow, load, receded)
    if load is not None:  # of a step that holds what rests, the forces cancel
        slow = slow + _slow(contacts, path.support / contacts.dt)
    contacts.lift_off(path)
    impacts = schedule(contacts, *lax.stop_gradient((path, slow, theta)), rounds)
    events, after, left, undecided = checkpoint_name(impacts, IMPACTS)
    moved, jump = found(_end(after), lambda: _end(go_through(contacts, path, events, theta)))
    touched = (touched | after.hit)[:, None]
    position = where(touched, moved, x_free)
    velocity = where(touched, v_end + jump, v_free)
    end = None
    if not (contacts.alone or contacts.many):
        end = at_end(*lax.stop_gradient((contacts, after)))
        undecided = undecided + jnp.sum(by_chance(contacts, after, events, end, slow)).astype(jnp.int32)
    if not contacts.alone:
        unchanged = jnp.zeros_like(velocity), jnp.zeros_like(position)
        operands = lax.stop_gradient((contacts, after, end, velocity, slow))
        kick, shift = where_needed(left > 0, settle, unchanged, *operands)
        position, velocity = position + shift, velocity + kick
    position = where(lost[:, None], jnp.nan, position)  # a surface that cannot say where it is: announced
    return position, velocity, unresolved + left + undecided + contacts.left_out


def at_end(contacts: Contacts, path: Path) -> Look:
    """What there is to know of the contacts where the step ends."""
    return contacts.look(path, jnp.ones(contacts.count, path.s.dtype))


def settle(contacts: Contacts, path: Path, end: Look | None, velocity: Array, slow: Array) -> tuple[Array, Array]:
    """What brings to rest together all that touches at the end of a step which had more impacts than are followed.

    Changes of velocity and position, (particle, dim). They are not differentiated: the impacts are counted.
    """
    contacts.axis = None  # other devices may have nothing to settle
    end = at_end(contacts, path) if end is None else end
    small = contacts.roundoff(path.x)
    touches = (end.gap <= small + contacts.open(slow)) & contacts.possible
    speed = contacts.relative(velocity) + end.recession[:, None] * end.normal + contacts.landing(end.gap, end.normal)
    gap = end.gap / contacts.dt
    problem = Problem.of(contacts, end.normal, speed, gap, jnp.zeros_like(path.s)[:, None], touches, gap, True)
    return together(problem, small)


def _slow(contacts: Contacts, dv: Array) -> Array:
    """An approach, (contact,), m a step, that is none beside what forces do in a step."""
    return 1e-3 * contacts.dt * contacts.both(jnp.add, length(lax.stop_gradient(dv)))


def answer(
    contacts: Contacts, x: Array, v: Array, acceleration: Array, stays: Array | None = None
) -> Callable[[Array], Array]:
    """What contacts at rest add to velocities (particle, dim) at the end of a step from (x, v), as a function of these.

    For steps that solve for their end: u = v + dt a(x + dt u, u) + answer(v + dt a(x + dt u, u)). The acceleration
    without contact, at the start, says how fast an approach the forces of a step make. Who ``stays``, (contact,), may
    be known.
    """
    (gap, _, normal, recession, _), small, touching = at_start_of_fall(contacts, x, v, acceleration)
    stays = touching if stays is None else stays
    standing, forced = jnp.zeros((len(x), 1), x.dtype), is_forced(contacts, acceleration)
    surface = (recession + contacts.gained)[:, None] * normal + contacts.landing(gap, normal)

    def kick(u):
        velocity = contacts.relative(u) + surface
        problem = Problem.of(contacts, normal, velocity, jnp.zeros_like(gap), standing, stays, gap * 0, forced)
        return at_rest(problem, small).kick

    return kick


def at_start_of_fall(contacts: Contacts, x: Array, v: Array, acceleration: Array) -> tuple[Look, Array, Array]:
    """What `at_start` says of a step from (x, v) with this acceleration."""
    dv = contacts.dt * acceleration
    path = free_path(x, contacts.dt * (v + dv / 2), dv, contacts.dt)
    contacts.near(path)
    contacts.gained, _ = motion_of_surfaces(contacts, path)
    return at_start(contacts, path, _slow(contacts, dv))


def motion_of_surfaces(contacts: Contacts, path: Path) -> tuple[Array | float, Array | float]:
    """By how much faster each surface recedes where the step ends, m/s, and how far it has receded then, m, (contact,):
    from the place where this path ends."""
    moving = [moves(collider, contacts.dim) for collider in contacts.colliders]
    if not any(moving):
        return 0.0, 0.0
    end = path.position(jnp.ones_like(path.s))

    def of(collider):
        look = jax.vmap(jax.value_and_grad(collider), (None, 0))
        _, before = look(contacts.t0, path.x)
        first, _ = look(contacts.t0, end)
        last, after = look(contacts.t0 + contacts.dt, end)
        return jnp.stack([after - before, last - first])

    still = jnp.zeros((2, len(path.x)), path.x.dtype)
    walls = [of(collider) if goes else still for collider, goes in zip(contacts.colliders, moving, strict=True)]
    return tuple(jnp.concatenate([*walls, jnp.zeros((2, len(contacts.i)), path.x.dtype)], axis=1))


def is_forced(contacts: Contacts, acceleration: Array) -> Array:
    """Whether anything presses by more than rounding: an acceleration, (particle, dim), or that of a surface."""
    return contacts.largest(length(acceleration)) + contacts.largest(jnp.abs(contacts.gained)) > 0


def _end(path: Path) -> tuple[Array, Array]:
    """The positions at the end of the step, and what impacts have added to the velocities."""
    return path.position(jnp.ones_like(path.s)), path.jump


def hold(
    contacts: Contacts,
    x: Array,
    v: Array,
    displacement: Array,
    dv: Array,
    theta: Array,
    slow: Array,
    load: Array | None,
    receded: Array | float,
) -> tuple[Path, Array, Array, Array, Array]:
    """The paths with the forces of what touches at the start and does not bounce, the velocity at their end, who is
    touched by them, the number of contacts that are not resolved, and who has a collider without a distance there."""
    (gap, _, normal, recession, _), small, stays = at_start(contacts, free_path(x, displacement, dv, contacts.dt), slow)
    surface = (recession + contacts.gained)[:, None] * normal + contacts.landing(gap, normal)
    end_speed = contacts.relative(v + dv) + surface
    gap_end = gap + jnp.sum(contacts.relative(displacement) * normal, axis=-1) + receded
    forced = is_forced(contacts, dv if load is None else load - v)
    problem = Problem.of(contacts, normal, end_speed, gap_end / contacts.dt, theta, stays, gap / contacts.dt, forced)
    if load is None:
        rest = at_rest(problem, small)
    else:
        may_open = small + contacts.dt * jnp.abs(contacts.gained)
        rest = at_rest(problem, small, contacts.relative(load) + surface, may_open)
        in_the_solve = functools.partial(derivative_along, v + dv - load)
        support, rub = rest.support + in_the_solve(rest.carried), rest.rub + in_the_solve(rest.rub)
        rest = rest._replace(support=support, rub=rub)
    far = (contacts.reach > 0) & (small > 0.05 * contacts.reach)  # from the origin: nobody can say whether they touch
    unresolved = rest.unresolved + jnp.sum(is_deep(contacts, rest.gap, small) | (stays & far)).astype(jnp.int32)
    touched = decided(_touched(contacts, rest.on) | jnp.any(rest.kick != 0, axis=-1))
    contacts.resting = stays
    moved = displacement + theta * contacts.dt * rest.kick
    ground = contacts.of_colliders(rest.push)
    path = free_path(x + rest.shift, moved, dv + rest.kick, contacts.dt, rest.support, rest.rub, ground)
    lost = decided(_touches_a_collider(contacts, jnp.isnan(gap)) & contacts.alive)
    return path, v + dv + rest.kick, touched, unresolved, lost


def derivative_along(y: Array, direction: Array) -> Array:
    """0, with the derivative of the component of y, (particle, dim), along a direction."""
    direction = unit(lax.stop_gradient(direction))
    return jnp.sum(direction * (y - lax.stop_gradient(y)), axis=-1, keepdims=True) * direction


def at_start(contacts: Contacts, path: Path, slow: Array) -> tuple[Look, Array, Array]:
    """What there is to know of the contacts where the step starts, the gaps (contact,) that are none, and who touches
    and does not bounce."""
    start = contacts.look(path, jnp.zeros_like(contacts.both(jnp.add, path.s)))
    small = contacts.roundoff(path.x)
    slowly = -start.slope <= impulsive_limit(contacts, start.normal, path) + slow
    touches = start.gap <= small + contacts.open(slow)
    return start, small, decided(touches & slowly & contacts.possible)


def is_deep(contacts: Contacts, gap: Array, small: Array) -> Array:
    """Whether an overlap, (contact,), is more than rounding."""
    return gap < -2 * small - 1e-6 * contacts.reach


def _touched(contacts: Contacts, on: Array) -> Array:
    wall, pairs = _touches_a_collider(contacts, on), on[contacts.walls :]
    return most(most(wall, contacts.i, pairs), contacts.j, pairs) if len(contacts.i) else wall


def _touches_a_collider(contacts: Contacts, on: Array) -> Array:
    return jnp.any(on[: contacts.walls].reshape(-1, contacts.particles), axis=0)
