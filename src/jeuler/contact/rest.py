"""What touches at the start of a step and stays in touch: the contact forces through the step.

Complementarity on the level of velocities, after J. J. Moreau (1988) and M. Anitescu, F. A. Potra (1997):

    0 <= p_n,   0 <= n.v(end),   p_n n.v(end) = 0,   |p_t| <= friction p_n, against v_t(end)

with v(end) the relative velocity at the end of the step, its forces and all impulses p included. Written as a fixed
point of a projection (P. Alart, A. Curnier, 1991)

    p = proj(p - r v(end)),   proj(y) = y_n^+ n + y_t min(1, friction y_n^+ / |y_t|)

it is iterated with Nesterov's acceleration and restarts (H. Mazhar et al., ACM Transactions on Graphics 34, 2015, who
do so on the friction cone), r the inverse of each contact's response, split among the contacts of a ball (R. Tonge et
al., ACM Transactions on Graphics 31, 2012). One step of Newton's method on the same equation ends it, and gives the
derivatives: those of the implicit function theorem on the active set.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core.vectors import length
from jeuler.contact.contacts import Contacts

DENSE_UP_TO = 64  # unknowns; beyond, matrix-free
ITERATIONS = 400


class Forces(NamedTuple):
    """The impulses of a step, (contact, dim), N s, and which contacts they did not bring to rest."""

    impulse: Array
    unresolved: Array  # (), int32


def contact_forces(contacts: Contacts, normal: Array, velocity: Array, active: Array) -> Forces:
    """The impulses p of the contacts that are active, for relative velocities (contact, dim) without them."""
    friction, response = contacts.friction, contacts.response()
    shares = contacts.both(jnp.maximum, _number_of_contacts(contacts, active))
    rate = jnp.where(response > 0, 1 / jnp.where(response > 0, response * shares, 1), 0)[:, None]

    def project(y):
        y_n = jnp.sum(y * normal, axis=-1, keepdims=True)
        push = jnp.where(active[:, None] & (y_n > 0), y_n, 0)
        y_t = y - y_n * normal
        size, most = length(y_t)[:, None], friction * push
        return push * normal + jnp.where(size <= most, y_t, y_t * (most / jnp.where(size > most, size, 1)))

    def improve(p, velocity):
        return project(p - rate * (velocity + contacts.relative(contacts.push(p))))

    if len(contacts.colliders) == 1 and not len(contacts.i):  # each particle for itself: exact at once
        return Forces(improve(jnp.zeros_like(velocity), velocity), jnp.int32(0))
    p, error = _iterate(improve, rate, lax.stop_gradient(velocity))
    scale = jnp.max(jnp.where(active, length(velocity), 0), initial=0)
    rounding = 64 * jnp.finfo(velocity.dtype).eps * jnp.max(length(velocity), initial=0)
    unresolved = jnp.sum(active & (error > 1e-3 * scale + rounding)).astype(jnp.int32)
    return Forces(_newton(lambda p: p - improve(p, velocity), p), unresolved)


def _number_of_contacts(contacts: Contacts, active: Array) -> Array:
    one = jnp.where(active, 1.0, 0.0).astype(contacts.radius.dtype)
    total = jnp.zeros_like(contacts.radius)
    for k in range(len(contacts.colliders)):
        total = total + one[k * contacts.particles : (k + 1) * contacts.particles]
    if len(contacts.i):
        total = total.at[contacts.i].add(one[contacts.walls :]).at[contacts.j].add(one[contacts.walls :])
    return jnp.maximum(total, 1)


def _iterate(improve: Any, rate: Array, velocity: Array) -> tuple[Array, Array]:
    """The fixed point by accelerated iterations, and what is left of each contact's velocity; not differentiated."""
    improve, rate = lax.stop_gradient((jax.tree_util.Partial(improve), rate))
    eps = jnp.finfo(velocity.dtype).eps
    enough = jnp.maximum(1e-9, 30 * eps) * jnp.max(length(velocity), initial=0)
    safe_rate = jnp.where(rate > 0, rate, 1)

    def one(state):
        p, ahead, weight, _, k = state
        new = improve(ahead, velocity)
        restart = jnp.sum((ahead - new) * (new - p)) > 0
        weight = jnp.where(restart, 1.0, weight).astype(velocity.dtype)
        next_weight = (1 + jnp.sqrt(1 + 4 * weight**2)) / 2
        error = jnp.where(rate[:, 0] > 0, length((new - ahead) / safe_rate), 0)
        ahead = new + jnp.where(restart, 0, (weight - 1) / next_weight) * (new - p)
        return new, ahead, next_weight, error, k + 1

    def go_on(state):
        *_, error, k = state
        return (jnp.max(error, initial=0) > enough) & (k < ITERATIONS)

    zero = jnp.zeros_like(velocity)
    start = zero, zero, jnp.ones((), velocity.dtype), jnp.full(len(velocity), jnp.inf, velocity.dtype), 0
    p, _, _, error, _ = lax.while_loop(go_on, one, start)
    return p, error


def _newton(residual: Any, p: Array) -> Array:
    """p after one step of Newton's method, as a function of all that the residual depends on."""
    p = lax.stop_gradient(p)
    value, slope = jax.linearize(residual, p)
    if p.size > DENSE_UP_TO:
        from jax.scipy.sparse.linalg import bicgstab

        # p is the solution to the tolerance of the iteration; the linear solve is for the derivatives alone
        step, _ = bicgstab(slope, value - lax.stop_gradient(value), tol=1e-9, maxiter=200)
        return p - step
    return p - _dense_solve(slope, value)


def _dense_solve(slope: Any, value: Array) -> Array:
    """slope^-1 value, by least squares; where contacts are redundant, some forces that do the same."""
    n = value.size
    columns = jax.vmap(lambda d: slope(d.reshape(value.shape)).ravel())(jnp.eye(n, dtype=value.dtype))
    matrix = columns.T
    small = 1e3 * jnp.finfo(value.dtype).eps * jnp.eye(n, dtype=value.dtype)

    def least_squares(m):
        def solve(_, b):
            half = lax.linalg.cholesky(m.T @ m + small)
            y = lax.linalg.triangular_solve(half, (m.T @ b)[:, None], left_side=True, lower=True)
            return lax.linalg.triangular_solve(half, y, left_side=True, lower=True, transpose_a=True)[:, 0]

        return solve

    fixed = lax.stop_gradient(matrix)
    solved = lax.custom_linear_solve(
        lambda d: matrix @ d, value.ravel(), least_squares(fixed), transpose_solve=least_squares(fixed.T)
    )
    return solved.reshape(value.shape)


def displacements(contacts: Contacts, normal: Array, gap: Array, on: Array) -> tuple[Array, Array]:
    """The displacements (particle, dim) that close the gaps of the contacts in ``on``, (contact,), and what is left.

    q with  gap + n.(displacement by q n) = 0,   displacement = M^-1 J^T q: the least in the metric of the masses.
    """

    def opened(q):
        return jnp.sum(contacts.relative(contacts.push(q[:, None] * normal)) * normal, axis=-1)

    response = contacts.response()
    safe = jnp.where(on & (response > 0), response, 1)
    target = jnp.where(on, -gap, 0)
    if len(contacts.colliders) == 1 and not len(contacts.i):
        q = jnp.where(on, target / safe, 0)
        return contacts.push(q[:, None] * normal), jnp.zeros_like(gap)

    def system(q):  # in units of the displacement that a contact alone would need
        return jnp.where(on, opened(jnp.where(on, q / safe, 0)), q)

    if gap.size > DENSE_UP_TO:
        from jax.scipy.sparse.linalg import bicgstab

        q, _ = bicgstab(system, target, tol=1e-6, maxiter=60)
    else:
        q = _dense_solve(system, target)
    moved = contacts.push(jnp.where(on, q / safe, 0)[:, None] * normal)
    left = jnp.where(on, gap + jnp.sum(contacts.relative(moved) * normal, axis=-1), 0)
    return moved, left
