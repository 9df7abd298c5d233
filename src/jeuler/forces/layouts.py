"""Layouts: in what order the edges of a graph lie in memory, so that the incidence operator and its transpose
are fast.

- `Shifts`: all edges (i, i + k) of one offset k make a group. B subtracts an array from itself shifted by k,
B^T adds
  two shifted copies. Slots are contiguous, nothing is looked up. Cloth, ropes, hair, lattices.
- `Rows`: any graph. Each particle has a row with one slot for each of its edges; both ends hold the edge,
with
  opposite signs, so that B^T sums a row and needs no look-up, and B gathers only the far ends.
- `Pairs`: a few edges, or few thousand. Two gathers and two scatters, as one would write it by hand.

Slots may be empty; what a force puts there must be 0, which `Layout.to_slots` sees to.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.forces import incidence


class Layout:
    """Where the edges lie in memory. Hashable by identity: layouts are made once a topology and cached.

    Attributes:
      copies: how often each edge is held, 1 or 2.
      clean: whether B x is 0 in empty slots. Where it is not, a force must vanish there: stiffness 0 does it.
      slot_edges: one integer array a group: the edge in each slot, -1 for none.
      tables: the integer and boolean arrays that the two maps look things up in.
    """

    copies: int
    clean: bool
    particles: int
    slot_edges: tuple[np.ndarray, ...]
    tables: tuple[np.ndarray, ...]

    def difference(self, x: Array) -> list[Array]:
        """B x: (particle,) to one array of slots a group."""
        return incidence.difference_p.bind(x, *self.tables, layout=self)

    def accumulate(self, slots: Sequence[Array]) -> Array:
        """B^T f: one array of slots a group to (particle,)."""
        return incidence.accumulate_p.bind(*slots, *self.tables, layout=self)

    def stored(self, slots: list[Array]) -> list[Array]:
        """The same slots, they and their cotangents stored if both ends of an edge read one slot.

        For the d of springs, whose cotangent is a sum of products; that of the velocities is one product, better
        worked out again at either end (cloth 64 x 64: the gradient takes 5.1 instead of 6.4 ns a spring).
        """
        return [incidence.stored(x) for x in slots] if self.copies == 1 else slots

    def to_slots(self, x: Array) -> list[Array]:
        """A value of each edge, () or (edge,), as one array a group; empty slots hold 0 where B x may not be
        0."""
        if x.ndim == 0:
            return [x if self.clean else jnp.where(edges < 0, 0, x) for edges in self.slot_edges]
        x = jnp.concatenate([x, jnp.zeros_like(x, shape=(1,))])  # slot -1 reads the zero at the end
        return [x[np.where(edges < 0, len(x) - 1, edges)] for edges in self.slot_edges]

    def _difference(self, x: Array, *tables: Array) -> list[Array]:
        raise NotImplementedError

    def _accumulate(self, slots: Sequence[Array], *tables: Array) -> Array:
        raise NotImplementedError


class Shifts(Layout):
    """Edges of constant offset k: slot s of a group holds the edge (s - k, s).

        x padded      0 0 | x0 x1 x2 x3 | 0 0        k = 2
        minus shifted       0  0  x0 x1 x2 x3        slots 0 .. particles + k - 1; the first and last k are
        empty B^T f at i    = f[i + k] - f[i]

    The padding costs k empty slots at each end and frees both maps of branches, so that they vectorise. A
    slot takes 2 loads a component in B, 2 in B^T, no index and no mask: an empty slot holds the difference of
    some two particles, which a stiffness of 0 takes out.
    """

    copies = 1
    clean = False

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

    def _difference(self, x, *tables):
        n, reach = self.particles, max(self.offsets)
        # a pad alone runs through an older, slower loop of XLA on CPU than one fused with arithmetic: 20 % of the step
        x = jnp.pad(incidence.as_stored(x), [(0, 0)] * (x.ndim - 1) + [(reach, reach)])
        return [x[..., reach - k : reach + n] - x[..., reach : reach + n + k] for k in self.offsets]

    def _accumulate(self, slots, *tables):
        n = self.particles
        return sum(f[..., k:] - f[..., :n] for k, f in zip(self.offsets, slots, strict=True))


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
    clean = True

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
    clean = True

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
