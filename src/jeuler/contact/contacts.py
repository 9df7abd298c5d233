"""What can touch what in one step: particles and colliders, and pairs of balls, as one list of contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core.choice import where
from jeuler._core.vectors import direction, length, total, unit
from jeuler.contact.colliders import Plane
from jeuler.contact.linear import DENSE_UP_TO
from jeuler.contact.partners import AMONG, BY_SLICES, THERE, Partners, add, rows
from jeuler.contact.paths import Path
from jeuler.graphs.cells import rows_of_neighbours

NARROWER = 8  # reaches, each half of the one before, that are tried where pairs are more than there is room for
WAY_OF_FORCES = 1e3  # of an approach that is none, is the way that the forces of a step make
TOUCH, LIFT = 8, 16  # units in the last place of the coordinates
ROW = 24  # balls within reach of one: 12 can touch one of their size in space
CANDIDATES = 2  # pairs followed in a step, for each particle and dimension, where there are many more of them


class Look(NamedTuple):
    """Gap, normal and relative motion of each contact, each at its own time."""

    gap: Array  # (contact,), distance between the surfaces, m
    slope: Array  # (contact,), d gap / ds, m a step
    normal: Array  # (contact, dim), on the first partner
    recession: Array  # (contact,), speed of the surface away from it, m/s
    speed: Array  # (contact, dim), relative dx/ds of the partners, m a step


@jax.tree_util.register_pytree_node_class
class Contacts:
    """The contacts of one step: first each collider with all particles, in their order, then the pairs.

    An array with one row a contact has leading axis ``contact`` = colliders * particles + pairs.
    """

    colliders: tuple[Any, ...]
    particles: int
    dim: int
    row: int  # the most balls within reach of one, where `near` is to find the pairs; 0 where they are named
    alone: bool  # whether each particle has one contact at most
    t0: Array
    dt: Array
    restitution: Array
    friction: Array
    radius: Array  # (particle,), m
    inverse_mass: Array  # (particle,), 1/kg, 0 for what cannot move
    alive: Array  # (particle,)
    i: Partners  # (pair,), the first particle
    j: Partners
    listed: Array  # (pair,), False in slots without a pair
    parts: tuple[Array, Array]  # of each, (pair,): what of a change of their relative velocity falls to either
    possible: Array  # (contact,), which can occur: both partners are alive, and one of them can move
    reach: Array  # (contact,), the distance of centres, or from the surface, at which partners touch, m
    left_out: Array  # how many pairs found no slot

    def __init__(self, collisions: Any, t0: Array, dt: Array, x: Array, mass: Array, alive: Array | None) -> None:
        dtype = x.dtype
        self.colliders, self.particles, self.dim = collisions.colliders, *x.shape
        self.t0, self.dt = t0.astype(dtype), dt.astype(dtype)
        self.restitution, self.friction = collisions.restitution.astype(dtype), collisions.friction.astype(dtype)
        self.radius = jnp.broadcast_to(collisions.radius.astype(dtype), self.particles)
        mass = mass if alive is None else where(alive, mass, jnp.inf)  # whatever the mass of a dead slot is
        self.inverse_mass = jnp.broadcast_to(1 / mass.astype(dtype), self.particles)
        self.alive = jnp.ones(self.particles, bool) if alive is None else alive
        self.row = (collisions.capacity or ROW) if collisions.pairs == "near" else 0
        self.alone = len(self.colliders) == 1 and not collisions.pairs
        if not self.row:
            named = np.array(collisions.pairs, np.int32).reshape(-1, 2)
            self.alone |= not self.colliders and len(np.unique(named)) == named.size
            few = 0 < len(named) <= BY_SLICES and self.particles <= AMONG
            i, j = (tuple(k.tolist()) if few else jnp.asarray(k) for k in named.T)
            self._follow(i, j, jnp.ones(len(i), bool))
        self.left_out = jnp.int32(0)
        self.lift: list[Array | float] = [0.0] * len(self.colliders)
        self.resting: Array | bool = False  # (contact,), which are held from the start of the step
        self.gained: Array | float = 0.0  # (contact,), m/s, by how much faster its surface recedes where the step ends
        self.axis: str | None = getattr(collisions, "axis", None)  # of the devices that share the particles

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        few = ("i", "j") if isinstance(vars(self).get("i"), tuple) else ()
        fixed = {name: getattr(self, name) for name in ("particles", "dim", "row", "alone", "axis", *few)}
        names = tuple(name for name in vars(self) if name not in fixed)
        return tuple(getattr(self, name) for name in names), (names, *fixed.items())

    @classmethod
    def tree_unflatten(cls, kept: tuple[Any, ...], values: tuple[Any, ...]) -> Contacts:
        self = object.__new__(cls)
        names, *fixed = kept
        vars(self).update(fixed, **dict(zip(names, values, strict=True)))
        return self

    def _follow(self, i: Partners, j: Partners, listed: Array) -> None:
        """Have these pairs, (pair,), and what is known of them before they move."""
        self.i, self.j, self.listed = i, j, listed
        first, second = rows(self.inverse_mass, i), rows(self.inverse_mass, j)
        both = first + second
        response = where(both > 0, both, 1)
        self.parts = first / response, -second / response
        wall = jnp.tile(self.alive & (self.inverse_mass > 0), len(self.colliders))
        self.possible = jnp.concatenate([wall, listed & rows(self.alive, i) & rows(self.alive, j) & (both > 0)])
        self.reach = self.both(jnp.add, self.radius)

    @property
    def walls(self) -> int:
        return len(self.colliders) * self.particles

    @property
    def count(self) -> int:
        return self.walls + len(self.i)

    @property
    def many(self) -> bool:
        """Whether there are so many pairs that what rests together is solved for by iterations alone."""
        return not self.alone and len(self.i) * (self.dim + 1) > DENSE_UP_TO

    @property
    def capacity(self) -> int:
        """How many pairs are followed in a step, where they are many."""
        return CANDIDATES * self.dim * self.particles

    @property
    def follows_all(self) -> bool:
        """Whether each step has all contacts in its list, in their order."""
        return not self.row and len(self.i) <= 2 * self.capacity

    def largest(self, x: Array) -> Array:
        """The largest of x, at least 0, on all devices that share the particles. Not in a loop, where these part."""
        most = jnp.max(jax.lax.stop_gradient(x), initial=0)
        return most if self.axis is None else jax.lax.pmax(most, self.axis)

    def total(self, x: Array) -> Array:
        """The sum of x, likewise."""
        return jnp.sum(x) if self.axis is None else jax.lax.psum(jnp.sum(x), self.axis)

    def open(self, slow: Array) -> Array:
        """Up to which gap, (contact,), m, a contact that is slow rests; slow: an approach that is none, m a step.

        What the solve of the step before may have left; among many contacts, the way that the forces of a step make.
        """
        return (WAY_OF_FORCES if self.many else 1e-3) * slow

    def landing(self, gap: Array, normal: Array) -> Array:
        """The relative velocity, (contact, dim), with which what rests at a distance may close its gap in this step.

        Source: D. E. Stewart, J. C. Trinkle, International Journal for Numerical Methods in Engineering 39, 1996.
        """
        return jnp.maximum(gap, 0)[:, None] / self.dt * normal if self.many else jnp.zeros_like(normal)

    def near(self, path: Path) -> None:
        """Where there are many pairs, keep those that can meet in this step, and count those beyond the capacity.

        Balls that are further apart than four times the longest way of any of them do not meet. Where too many are
        nearer, the nearest are kept.
        """
        if self.row:
            return self._find(path)
        if self.follows_all:
            return
        capacity = self.capacity
        way = jax.lax.stop_gradient(length(path.way) + length(path.bend))
        x = jax.lax.stop_gradient(path.x)
        apart = length(x[self.i] - x[self.j]) - self.radius[self.i] - self.radius[self.j]
        alive = self.alive[self.i] & self.alive[self.j]
        reaches = 4 * jnp.max(way) * 0.5 ** jnp.arange(NARROWER, dtype=apart.dtype)
        numbers = jnp.sum((apart <= reaches[:, None]) & alive, axis=1)
        widest = jnp.argmax(numbers <= capacity)  # the widest reach that has room; without any, the narrowest
        widest = where(jnp.any(numbers <= capacity), widest, NARROWER - 1)
        kept = jnp.nonzero((apart <= reaches[widest]) & alive, size=capacity, fill_value=0)[0]
        number = jnp.minimum(numbers[widest], capacity)
        self.left_out = (numbers[0] - number).astype(jnp.int32)
        i, j = rows(jnp.asarray(self.i), kept), rows(jnp.asarray(self.j), kept)
        self._follow(i, j, jnp.arange(capacity) < number)

    def _find(self, path: Path) -> None:
        """The pairs of all balls that can meet in this step, by a list of cells; those beyond the rows are counted."""
        n, capacity = self.particles, min(self.capacity, self.particles * (self.particles - 1) // 2)
        x, way, radius = lax.stop_gradient((path.x, length(path.way) + length(path.bend), self.radius))
        way = 4 * jnp.max(where(self.alive & jnp.isfinite(way), way, 0), initial=0)
        coarse = 1e-6 * jnp.max(where(jnp.isfinite(x), jnp.abs(x), 0), initial=1e-30)  # cells are counted by int32
        reach = jnp.maximum(2 * jnp.max(radius, initial=0) + way, coarse)
        others, missed = rows_of_neighbours(x, self.alive, 1.001 * reach, self.row, self.row // 2 + 4, None)
        i, j = jnp.broadcast_to(jnp.arange(n)[:, None], others.shape), jnp.maximum(jnp.sort(others, axis=1), 0)
        moves = self.inverse_mass[i] + self.inverse_mass[j] > 0
        wanted = (j > i) & moves & (length(x[i] - x[j]) - radius[i] - radius[j] <= way)
        number = jnp.sum(wanted, dtype=jnp.int32)
        kept = jnp.nonzero(wanted.ravel(), size=capacity, fill_value=0)[0]
        listed = jnp.arange(capacity) < number
        self.left_out = missed + jnp.maximum(number - capacity, 0)
        i, j = (where(listed, k.ravel()[kept], none) for k, none in ((i, 0), (j, 1)))
        self._follow(i, j, listed)

    def convex(self) -> Array:
        """Where the gap is a convex function of the place of the first partner relative to the second."""
        walls = np.repeat([getattr(collider, "convex", False) for collider in self.colliders], self.particles)
        return jnp.concatenate([jnp.asarray(walls, bool), jnp.ones(len(self.i), bool)])

    def curved(self) -> Array:
        """Where the normal may be another one beside the place of contact."""
        walls = np.repeat([not isinstance(collider, Plane) for collider in self.colliders], self.particles)
        return jnp.concatenate([jnp.asarray(walls, bool), jnp.ones(len(self.i), bool)])

    def first(self, y: Array) -> Array:
        """y of the first partner of each contact, y being (particle, ...)."""
        return jnp.concatenate([*[y] * len(self.colliders), *([rows(y, self.i)] if len(self.i) else [])])

    def second(self, y: Array) -> Array:
        """What the second partner of each contact has of y; 0 for a collider."""
        walls = jnp.zeros((self.walls, *y.shape[1:]), y.dtype)
        return jnp.concatenate([walls, rows(y, self.j)]) if len(self.j) else walls

    def relative(self, y: Array) -> Array:
        """y of the first partner less that of the second; of a particle at a collider just y."""
        pairs = [rows(y, self.i) - rows(y, self.j)] if len(self.i) else []
        return jnp.concatenate([*[y] * len(self.colliders), *pairs])

    def both(self, join: Callable[[Array, Array], Array], y: Array) -> Array:
        """join(y of the first, y of the second), where there is no second y of the first; y is (particle,)."""
        pairs = [join(rows(y, self.i), rows(y, self.j))] if len(self.i) else []
        return jnp.concatenate([*[y] * len(self.colliders), *pairs])

    def gather(self, first: Array, second: Array) -> Array:
        """The sums (particle, ...) of what contacts add to the first and take from the second partner."""
        total = self._of_walls(first)
        if len(self.i):
            total = add(total, self.i, first[self.walls :])
            total = add(total, self.j, -second[self.walls :])
        return total

    def _of_walls(self, change: Array) -> Array:
        """The sums (particle, ...) of what contacts with colliders add."""
        walls = [self._of_wall(k, change) for k in range(len(self.colliders))]
        return total(walls) if walls else jnp.zeros((self.particles, *change.shape[1:]), change.dtype)

    def of_colliders(self, change: Array) -> Array:
        """What each collider adds to each particle, (collider, particle, dim); none where there are no others."""
        walls = 0 if self.alone else self.walls
        own = change[:walls].reshape(-1, self.particles, self.dim)
        return where((self.inverse_mass > 0)[:, None], own, 0)

    def move(self, change: Array) -> Array:
        """The changes (particle, ...) by impulses that change the relative velocity by (contact, ...) if alone."""
        walls = self._of_walls(change)
        total = where((self.inverse_mass > 0)[:, None], walls, 0) if self.colliders else walls
        if len(self.i):
            pairs = change[self.walls :]
            for body, part in zip((self.i, self.j), self.parts, strict=True):
                total = add(total, body, part[:, None] * pairs)
        return total

    def close(self, active: Array, gap: Array) -> Array:
        """Who touches, or may be pushed into, (contact,)."""
        return active | (self.possible & (gap < 0.1 * self.reach))

    def rate(self, of: Array) -> Array:
        """One over the number of these contacts, (contact,), that the partner with more of them has."""
        one = of.astype(self.radius.dtype)
        return 1 / self.both(jnp.maximum, jnp.maximum(self.gather(one, -one), 1))

    def chosen(self, of: Array) -> tuple[Contacts | Chosen, Array]:
        """These contacts, (contact,), alone in a list where they are few among many, and their numbers in it."""
        capacity = self.capacity
        numbers = jnp.arange(self.count)
        if 2 * self.count <= 3 * capacity or self.count * (self.dim + 1) <= 4 * DENSE_UP_TO:
            return self, numbers
        kept = jnp.nonzero(of, size=capacity, fill_value=self.count)[0]
        body = jnp.arange(self.particles, dtype=jnp.int32)
        i = jnp.concatenate([jnp.tile(body, len(self.colliders)), jnp.asarray(self.i, jnp.int32)])
        further = self.particles  # one more, which stays
        j = jnp.pad(jnp.asarray(self.j, jnp.int32), (self.walls, 0), constant_values=further)
        i, j = (where(kept < self.count, k[kept], self.particles) for k in (i, j))
        return Chosen(i, j, jnp.pad(self.inverse_mass, (0, 1)), self.friction, self.dt, kept < self.count), kept

    def look(self, path: Path, s: Array) -> Look:
        """Gap, normal and relative motion of each contact, with its partners where they are at its own s."""
        parts = [self._look_at_collider(k, path, s) for k in range(len(self.colliders))]
        if len(self.i):
            x, speed = self._balls(path, s)
            distance, normal = direction(x)
            gap = distance[:, 0] - self.reach[self.walls :]
            parts.append(Look(gap, jnp.sum(normal * speed, axis=-1), normal, jnp.zeros_like(gap), speed))
        return Look(*map(jnp.concatenate, zip(*parts, strict=True)))

    def gap(self, path: Path, s: Array) -> Array:
        """The gap of each contact alone, (contact,)."""
        parts = []
        for k, collider in enumerate(self.colliders):
            own = self._of_wall(k, s)
            parts.append(jax.vmap(collider)(self.t0 + own * self.dt, path.position(own) + self.lift[k]) - self.radius)
        if len(self.i):
            parts.append(length(self._balls(path, s)[0]) - self.reach[self.walls :])
        return jnp.concatenate(parts)

    def _of_wall(self, k: int, y: Array) -> Array:
        """What contacts with this collider have of y, (contact, ...)."""
        return y[k * self.particles : (k + 1) * self.particles]

    def _look_at_collider(self, k: int, path: Path, s: Array) -> Look:
        s = self._of_wall(k, s)
        x, speed = path.position(s) + self.lift[k], path.speed(s)
        of_both = jax.vmap(jax.value_and_grad(self.colliders[k], argnums=(0, 1)))
        distance, (recession, slope) = of_both(self.t0 + s * self.dt, x)
        along = jnp.sum(slope * speed, axis=-1) + self.dt * recession
        return Look(distance - self.radius, along, unit(slope), recession, speed)

    def _balls(self, path: Path, s: Array) -> tuple[Array, Array]:
        """Place and dx/ds of the first ball of each pair relative to the second, (pair, dim), at its own s."""
        table = jnp.concatenate([path.x, path.way, path.bend, path.s[:, None]], axis=1)

        def of(k):
            x, way, bend, since = jnp.split(rows(table, k), [self.dim, 2 * self.dim, 3 * self.dim], axis=1)
            part = s[self.walls :, None] - since
            return x + part * (way + part / 2 * bend), way + part * bend

        (x, speed), (of_second, speed_of_second) = of(self.i), of(self.j)
        return x - of_second, speed - speed_of_second

    def roundoff(self, x: Array) -> Array:
        """How large a gap of zero may come out by roundoff, (contact,), m."""
        size = jnp.max(jnp.abs(x), axis=-1) + self.radius
        return jax.lax.stop_gradient(TOUCH * jnp.finfo(x.dtype).eps * self.both(jnp.maximum, size))

    def lift_off(self, path: Path) -> None:
        """Hold a particle that touches a collider a few roundings above it when it is tried against the others.

        So it passes over an edge that is flush with what it slides on.
        """
        if len(self.colliders) < 2:
            return
        self.lift = [0.0] * len(self.colliders)
        n = self.particles
        parts = [self._look_at_collider(k, path, jnp.tile(path.s, k + 1)) for k in range(len(self.colliders))]
        gap, normal = (jnp.concatenate([getattr(part, name) for part in parts]) for name in ("gap", "normal"))
        small = self.roundoff(path.x)[: self.walls]
        walls = [slice(k * n, (k + 1) * n) for k in range(len(self.colliders))]
        touching = (gap <= small)[:, None]
        for k, own in enumerate(walls):
            others = [
                where(
                    touching[m] & (jnp.sum(normal[m] * normal[own], axis=-1, keepdims=True) > -1e-3),
                    LIFT / TOUCH * small[m][:, None] * normal[m],
                    0,
                )
                for m in walls
                if m != own
            ]
            self.lift[k] = jax.lax.stop_gradient(sum(others[1:], others[0]))


class Chosen(NamedTuple):
    """Some of the contacts of a step, in a list; with methods as those of `Contacts`."""

    i: Array  # (contact,), the first particle; the number of particles in an empty slot
    j: Array  # (contact,), the second; the number of particles for a collider
    inverse_mass: Array  # (particle + 1,), 1/kg
    friction: Array
    dt: Array
    listed: Array  # (contact,), False in empty slots

    @property
    def alone(self) -> bool:
        return False

    @property
    def many(self) -> bool:
        return True

    def largest(self, x: Array) -> Array:
        return jnp.max(jax.lax.stop_gradient(x), initial=0)

    def close(self, active: Array, gap: Array) -> Array:
        return self.listed

    def rate(self, of: Array) -> Array:
        one = of.astype(self.dt.dtype)
        number = (
            jnp.zeros_like(self.inverse_mass).at[self.i].add(one, **THERE).at[self.j].add(one, **THERE).at[-1].set(0)
        )
        return 1 / jnp.maximum(jnp.maximum(rows(number, self.i), rows(number, self.j)), 1)

    def relative(self, y: Array) -> Array:
        y = jnp.pad(y, ((0, 1), *[(0, 0)] * (y.ndim - 1)))
        return rows(y, self.i) - rows(y, self.j)

    def move(self, change: Array) -> Array:
        first, second = rows(self.inverse_mass, self.i), rows(self.inverse_mass, self.j)
        response = where(first + second > 0, first + second, 1)
        shares = (part.reshape(-1, *[1] * (change.ndim - 1)) for part in (first / response, second / response))
        total = jnp.zeros((len(self.inverse_mass), *change.shape[1:]), change.dtype)
        for body, part in zip((self.i, self.j), shares, strict=True):
            total = total.at[body].add((part if body is self.i else -part) * change, **THERE)
        return total[:-1]
