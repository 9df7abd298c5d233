"""One step with contact: forces of what rests, then impacts at their times."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core.vectors import length
from jeuler.contact.contacts import Contacts
from jeuler.contact.impacts import go_through, impulsive_limit, schedule
from jeuler.contact.paths import Path, free_path, share_of_the_force
from jeuler.contact.rest import contact_forces, displacements


def resolve(
    contacts: Contacts, x: Array, v: Array, x_free: Array, v_free: Array, rounds: int
) -> tuple[Array, Array, Array]:
    """Position and velocity at the end of a step that led from (x, v) to (x_free, v_free), and what it left undone."""
    displacement, dv = x_free - x, v_free - v
    theta = share_of_the_force(displacement, v, dv, contacts.dt)
    contacts.near(free_path(x, displacement, dv, contacts.dt))
    slow = 1e-3 * contacts.dt * contacts.both(jnp.add, length(lax.stop_gradient(dv)))

    path, v_end, touched, unresolved = hold(contacts, x, v, displacement, dv, theta, slow)
    contacts.lift_off(path)
    events, left = schedule(contacts, *lax.stop_gradient((path, slow, theta)), rounds)
    path = go_through(contacts, path, events, theta)

    end = jnp.ones_like(path.s)
    touched = (touched | path.hit)[:, None]
    position = jnp.where(touched, path.position(end), x_free)
    velocity = jnp.where(touched, v_end + path.jump, v_free)
    lost = _without_distance(contacts, x)  # a surface that cannot say where it is: announced, not passed through
    position = jnp.where(lost[:, None], jnp.nan, position)
    return position, velocity, unresolved + left + contacts.left_out


def hold(
    contacts: Contacts, x: Array, v: Array, displacement: Array, dv: Array, theta: Array, slow: Array
) -> tuple[Path, Array, Array, Array]:
    """The paths with the forces of what touches at the start and does not bounce, the velocity at their end, who is
    touched by them, and the number of contacts that are not resolved."""
    path = free_path(x, displacement, dv, contacts.dt)
    at_start = jnp.zeros_like(contacts.both(jnp.add, path.s))
    gap, slope, normal, recession, _ = contacts.look(path, at_start)
    small = contacts.roundoff(x)
    stays = (gap <= small) & (-slope <= impulsive_limit(contacts, normal, path) + slow) & contacts.possible()
    stays = lax.stop_gradient(stays)

    def held(_):
        end_speed = contacts.relative(v + dv) + recession[:, None] * normal
        forces = contact_forces(contacts, normal, end_speed, stays)
        kick = contacts.push(forces.impulse)
        moved = displacement + theta * contacts.dt * kick
        at_end = gap + jnp.sum(contacts.relative(moved) * normal, axis=-1) + contacts.dt * recession
        pressed = jnp.sum(forces.impulse * normal, axis=-1) > 0
        on = lax.stop_gradient(stays & (pressed | (at_end < 0)))
        shift, left = displacements(contacts, normal, at_end, on)
        overlaps = jnp.sum(on & (left < -small - 1e-6 * contacts.both(jnp.add, contacts.radius)))
        return kick, shift, on, forces.unresolved + overlaps.astype(jnp.int32)

    def free(_):
        return jnp.zeros_like(x), jnp.zeros_like(x), jnp.zeros_like(stays), jnp.int32(0)

    kick, shift, on, unresolved = lax.cond(jnp.any(stays), held, free, None)
    touched = _is_touched(contacts, on)
    path = free_path(x + shift, displacement + theta * contacts.dt * kick, dv + kick, contacts.dt, kick)
    return path, v + dv + kick, touched, unresolved


def _is_touched(contacts: Contacts, on: Array) -> Array:
    wall = jnp.any(on[: contacts.walls].reshape(-1, contacts.particles), axis=0)
    pairs = on[contacts.walls :]
    return wall.at[contacts.i].max(pairs).at[contacts.j].max(pairs) if len(contacts.i) else wall


def _without_distance(contacts: Contacts, x: Array) -> Array:
    """Which particles have a collider that returns NaN where they are, (particle,)."""
    lost = jnp.zeros(contacts.particles, bool)
    for collider in contacts.colliders:
        lost = lost | jnp.isnan(jax.vmap(collider, (None, 0))(contacts.t0, lax.stop_gradient(x)))
    return lost & contacts.alive
