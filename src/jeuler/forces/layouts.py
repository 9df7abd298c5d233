"""Layouts: in what order the edges of a graph lie in memory, so that a force along them is fast.

    F = B^T (c B x),   c = law(|B x|^2, (B v).(B x), parameters)   one number an edge

- `Shifts`: all edges (i, i + k) of one offset k make a group. B subtracts an array from itself shifted by k, B^T adds
  two shifted copies. Slots are contiguous, nothing is looked up. Cloth, ropes, hair, lattices.
- `Rows`: any graph. Each particle has a row with one slot for each of its edges; both ends hold the edge,
with
  opposite signs, so that B^T sums a row and needs no look-up, and B gathers only the far ends.
- `Pairs`: a few edges, or few thousand. Two gathers and two scatters, as one would write it by hand.

Slots may be empty; c is 0 there, or B x is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._vectors import dot
from jeuler.forces import incidence
from jeuler.forces.hints import kept, stored
from jeuler.forces.laplacian import laplacian, products

Law = Callable[..., Array]  # (square, approach, *parameters) -> c, elementwise


class Layout:
    """Where the edges lie in memory. Hashable by identity: layouts are made once a topology and cached.

    Attributes:
      copies: how often each edge is held, 1 or 2.
      slot_edges: one integer array a group: the edge in each slot, -1 for none.
      tables: the integer and boolean arrays that the two maps look things up in.
    """

    copies: int
    particles: int
    slot_edges: tuple[np.ndarray, ...]
    tables: tuple[np.ndarray, ...]

    def difference(self, x: Array) -> list[Array]:
        """B x: (particle,) to one array of slots a group."""
        return incidence.difference_p.bind(x, *self.tables, layout=self)

    def accumulate(self, slots: Sequence[Array]) -> Array:
        """B^T f: one array of slots a group to (particle,)."""
        return incidence.accumulate_p.bind(*slots, *self.tables, layout=self)

    def central_force(
        self, law: Law, x: Sequence[Array], v: Sequence[Array], parameters: Sequence[list[Array] | Array]
    ) -> list[Array]:
        """B^T (c B x) with c = law(|B x|^2, (B v).(B x), *parameters): (particle,) for each component of x.

        Parameters are what `to_slots` made of them.
        """
        d, s = ([self.difference(component) for component in y] for y in (x, v))
        if self.copies == 1:  # both ends read one slot: stored, its cotangent too, not worked out again for either
            d = [[stored(slots) for slots in component] for component in d]
        by_group = zip(zip(*d, strict=True), zip(*s, strict=True), *parameters, strict=True)
        c = [stored(law(dot(d, d), dot(s, d), *own)) for d, s, *own in by_group]
        return [self.accumulate([a * b for a, b in zip(c, component, strict=True)]) for component in d]

    def to_slots(self, x: Array) -> list[Array] | Array:
        """A value of each edge, () or (edge,), as one array a group with 0 in empty slots, or what `by_group` takes."""
        if x.ndim == 0:
            return [x] * len(self.slot_edges)
        x = jnp.concatenate([x, jnp.zeros_like(x, shape=(1,))])  # slot -1 reads the zero at the end
        return [x[np.where(edges < 0, len(x) - 1, edges)] for edges in self.slot_edges]

    def by_group(self, parameter: list[Array] | Array) -> list[Array]:
        """What `to_slots` made, as one array a group."""
        assert isinstance(parameter, list)
        return parameter

    def _difference(self, x: Array, *tables: Array) -> list[Array]:
        raise NotImplementedError

    def _accumulate(self, slots: Sequence[Array], *tables: Array) -> Array:
        raise NotImplementedError


class Shifts(Layout):
    """Edges of constant offset k: slot s of a group holds the edge (s - k, s).

    The two maps and the layout of their slots are those of `jeuler.forces.laplacian`. What is one number for all edges
    is one array for all groups, of the longest one's length: half the memory traffic of cloth.
    """

    copies = 1

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        low, high = edges.min(axis=1), edges.max(axis=1)
        self.particles = particles
        self.offsets = tuple(int(k) for k in np.unique(high - low))
        groups = []
        for k in self.offsets:
            group = np.full(particles + k, -1, np.int32)
            chosen = high - low == k
            group[high[chosen]] = numbers[chosen]
            groups.append(group)
        self.slot_edges = tuple(groups)
        self.tables = ()

    def central_force(self, law, x, v, parameters):
        x, v = ([kept(component) for component in y] for y in (x, v))
        squares, approaches = (self.dot_differences(y, x) for y in (x, v))
        values = map(law, squares, approaches, *map(self.by_group, parameters))
        c = [stored(jnp.where(edges < 0, 0, value)) for edges, value in zip(self.slot_edges, values, strict=True)]
        return [laplacian(c, component, self.offsets) for component in x]

    def dot_differences(self, x: Sequence[Array], y: Sequence[Array]) -> list[Array]:
        """(B x).(B y), one array a group."""
        first, *others = (products(a, b, self.offsets) for a, b in zip(x, y, strict=True))
        return [sum(terms, start) for start, *terms in zip(first, *others, strict=True)]

    def to_slots(self, x):
        return jnp.broadcast_to(x, self.particles + max(self.offsets)) if x.ndim == 0 else super().to_slots(x)

    def by_group(self, parameter: list[Array] | Array) -> list[Array]:
        if isinstance(parameter, list):
            return parameter
        return [parameter[: self.particles + k] for k in self.offsets]


LONGEST_ROW = 32  # a particle with more edges has several rows, so that a hub does not pad all others
GROUP_COST = 2000  # slots that one more group of rows costs in overhead,
GROUP_SHARE = 1 / 60  # and at least this share of all, so that the program stays short


class Rows(Layout):
    """Any graph: a row of slots for each particle, both ends of an edge hold it.

        particle 7:  (7, 2) (7, 9) (7, 30)  -        slots of one row: x7 - x2, x7 - x9, x7 - x30, 0

    Rows are grouped by length (a few lengths, chosen to waste few slots) and lie as columns, (length, row),
    so that a loop runs over the rows. Particles are taken in reverse Cuthill-McKee order: far ends lie near
    in memory. A slot takes one gathered load a component in B and one plain load in B^T; holding both ends
    doubles the arithmetic and saves the look-ups of B^T, which cost more.

    f in both slots of an edge has opposite signs: B x has, and every even function of it times B x. On such f
    the sum over rows is B^T, the transpose of B for the product over edges, half the sum over slots.
    """

    copies = 2

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        self.particles = particles
        order = near_order(edges, particles)
        place = np.empty(particles, np.int32)
        place[order] = np.arange(particles, dtype=np.int32)
        near, far = place[edges.ravel()], place[edges[:, ::-1].ravel()]
        both = np.argsort(near, kind="stable")
        near, far, number = near[both], far[both], np.repeat(numbers, 2)[both]
        degree = np.bincount(near, minlength=particles)
        rank = np.arange(len(near)) - np.repeat(np.cumsum(degree) - degree, degree)

        # Rows: of each particle as many as its degree needs, all but the last one full.
        rows_of = -(-degree // LONGEST_ROW)
        owner = np.repeat(np.arange(particles), rows_of)
        first_row = np.cumsum(rows_of) - rows_of
        row, column = first_row[near] + rank // LONGEST_ROW, rank % LONGEST_ROW
        length = np.bincount(row, minlength=len(owner))

        # Groups: rows of like length, in the order of the particles.
        widths = group_widths(length)
        group = np.searchsorted(widths, length)
        sorted_rows = np.argsort(group, kind="stable")
        place_of_row = np.empty(len(owner), np.int32)
        place_of_row[sorted_rows] = np.arange(len(owner), dtype=np.int32)
        self.sizes = tuple(np.bincount(group, minlength=len(widths)).tolist())
        self.widths = tuple(int(w) for w in widths)

        far_tables, slot_edges, start = [], [], 0
        for width, size in zip(self.widths, self.sizes, strict=True):
            own = owner[sorted_rows[start : start + size]].astype(np.int32)
            table = np.tile(own, (width, 1))  # an empty slot holds the difference of a particle to itself
            edge = np.full((width, size), -1, np.int32)
            here = (place_of_row[row] >= start) & (place_of_row[row] < start + size)
            table[column[here], place_of_row[row[here]] - start] = far[here]
            edge[column[here], place_of_row[row[here]] - start] = number[here]
            far_tables.append(table)
            slot_edges.append(edge)
            start += size
        self.slot_edges = tuple(slot_edges)

        # Back to particles: the first row of each (or the zero behind all rows), and what further rows of
        # hubs give.
        first = np.where(rows_of > 0, place_of_row[np.minimum(first_row, len(owner) - 1)], len(owner))
        further = np.ones(len(owner), bool)
        further[first_row[rows_of > 0]] = False
        self.hubs = bool(further.any())
        hub_tables = (order[owner[further]], place_of_row[further]) if self.hubs else ()
        tables = (order, owner[sorted_rows], first[place], *hub_tables, *far_tables)
        self.tables = tuple(np.ascontiguousarray(table, np.int32) for table in tables)

    def _difference(self, x, *tables):
        order, owner, _ = tables[:3]
        far_tables = tables[5:] if self.hubs else tables[3:]
        x = take(x, order)
        own = take(x, owner)
        slots, start = [], 0
        for size, far in zip(self.sizes, far_tables, strict=True):
            slots.append(own[..., None, start : start + size] - take(x, far))
            start += size
        return slots

    def _accumulate(self, slots, *tables):
        first = tables[2]
        sums = [sum(f[..., m, :] for m in range(f.shape[-2])) for f in slots]
        rows = jnp.concatenate([*sums, jnp.zeros_like(sums[0][..., :1])], axis=-1)
        total = take(rows, first)
        if self.hubs:
            hub, row = tables[3:5]
            total = total.at[..., hub].add(take(rows, row), mode="promise_in_bounds")
        return total


class Pairs(Layout):
    """Not many edges, as one would write it: a slot an edge, two gathers in B, two scatters in B^T.

    As many slots as edges, and no padding. Up to some thousand edges, and in batches of such systems, that beats
    `Rows`: 866 springs of a mesh take 15 instead of 18 ns each, their gradient 44 instead of 58, and in a batch of 32,
    13 instead of 48 and 68 instead of 245. From 10,000 edges on the scatters cost more than `Rows`' second copies.
    """

    copies = 1

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        self.particles = particles
        self.slot_edges = (np.asarray(numbers, np.int32),)
        self.tables = (np.ascontiguousarray(edges[:, 0]), np.ascontiguousarray(edges[:, 1]))

    def _difference(self, x, *tables):
        i, j = tables
        return [take(x, i) - take(x, j)]

    def _accumulate(self, slots, *tables):
        (f,), (i, j) = slots, tables
        total = jnp.zeros((*f.shape[:-1], self.particles), f.dtype)
        total = total.at[..., i].add(f, mode="promise_in_bounds")
        return total.at[..., j].add(-f, mode="promise_in_bounds")


def take(x: Array, index: Array) -> Array:
    """x at index along its last axis; indices are known to be in range, which spares the program a check of
    each."""
    return x.at[..., index].get(mode="promise_in_bounds")


def near_order(edges: np.ndarray, particles: int) -> np.ndarray:
    """The particles in an order that puts joined ones near each other (reverse Cuthill-McKee)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    i, j = edges[:, 0], edges[:, 1]
    graph = coo_matrix((np.ones(2 * len(edges), np.int8), (np.r_[i, j], np.r_[j, i])), (particles, particles))
    return np.asarray(reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True), np.int32)


def group_widths(length: np.ndarray) -> np.ndarray:
    """The row lengths to pad to: the set with the fewest slots, a group counting as so many slots more.

    Dynamic programming over the lengths that occur: least[j] is the cost of the rows of the j shortest
    lengths.
    """
    lengths, counts = np.unique(length, return_counts=True)
    up_to = np.concatenate([[0], np.cumsum(counts)])
    group_cost = max(GROUP_COST, GROUP_SHARE * length.sum())
    least, cut = [0.0], []
    for j, width in enumerate(lengths):
        costs = [least[i] + (up_to[j + 1] - up_to[i]) * int(width) + group_cost for i in range(j + 1)]
        cut.append(int(np.argmin(costs)))
        least.append(costs[cut[-1]])
    widths, j = [], len(lengths)
    while j:
        widths.append(int(lengths[j - 1]))
        j = cut[j - 1]
    return np.array(widths[::-1])
