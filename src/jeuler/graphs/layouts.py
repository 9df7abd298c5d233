"""Layouts: in what order the edges of a graph lie in memory, so that a force along them is fast.

    F = B^T (c B x),   c = law(|B x|^2, (B v).(B x), parameters)   one number an edge

- `Shifts`: all edges (i, i + k) of one offset k make a group. B subtracts an array from itself shifted by k, B^T adds
  two shifted copies. Slots are contiguous, nothing is looked up. Cloth, ropes, hair, lattices.
- `Rows`: any graph. One end owns the edge and has its slot in its row: B gathers the far ends, B^T sums a row and
  gathers what the other edges of the particle give.
- `Pairs`: a few edges, or few hundred. Two gathers and two scatters, as one would write it by hand.

Slots may be empty; c is 0 there, or B x is.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core.vectors import dot, total
from jeuler._jax.materialise import as_stored, kept, stored
from jeuler.graphs import incidence
from jeuler.graphs.cells import nearest_image
from jeuler.graphs.laplacian import laplacian, products

Law = Callable[..., Array]  # (square, approach, *parameters) -> c, elementwise
Components = Sequence[Array]  # one array (particle,) a component
Slots = list[Array] | Array  # what `to_slots` makes of a parameter


class Layout(abc.ABC):
    """Where the edges lie in memory. Hashable by identity: layouts are made once a topology and cached.

    Attributes:
      slot_edges: one integer array a group: the edge in each slot, -1 for none.
    """

    particles: int
    slot_edges: tuple[np.ndarray, ...]

    @abc.abstractmethod
    def central_force(
        self,
        law: Law,
        x: Components,
        v: Components,
        parameters: Sequence[Slots],
        read_again: bool = False,
        box: Components | None = None,
    ) -> list[Array]:
        """B^T (c B x) with c = law(|B x|^2, (B v).(B x), *parameters): (particle,) for each component of x.

        Parameters are what `to_slots` made of them. ``read_again``: more than one kernel reads the force, as one does
        that limits a quadratic drag. ``box``: the sides of periodic space, in which B x is that to the nearest image.
        """

    def to_slots(self, x: Array) -> Slots:
        """A value of each edge, () or (edge,), as one array a group with 0 in empty slots, or what `by_group` takes."""
        if x.ndim == 0:
            return [x] * len(self.slot_edges)
        x = jnp.concatenate([x, jnp.zeros_like(x, shape=(1,))])  # slot -1 reads the zero at the end
        return [x[np.where(edges < 0, len(x) - 1, edges)] for edges in self.slot_edges]

    def by_group(self, parameter: Slots) -> list[Array]:
        """What `to_slots` made, as one array a group."""
        assert isinstance(parameter, list)
        return parameter


class Indexed(Layout):
    """Edges in one group of slots, whose ends are looked up in tables: B and B^T are primitives of their own.

    Attributes:
      tables: the integer arrays that B and B^T look things up in.
    """

    tables: tuple[np.ndarray, ...]

    def central_force(
        self,
        law: Law,
        x: Components,
        v: Components,
        parameters: Sequence[Slots],
        read_again: bool = False,
        box: Components | None = None,
    ) -> list[Array]:
        # both ends read one slot: d is stored, its cotangent too, not computed again for either
        sides = [None] * len(x) if box is None else box
        d = [stored(nearest_image(self.difference(one), side)) for one, side in zip(x, sides, strict=True)]
        s = [self.difference(component) for component in v]
        c = stored(law(dot(d, d), dot(s, d), *(parameter for (parameter,) in parameters)))
        return [self.accumulate(c * component) for component in d]

    def difference(self, x: Array) -> Array:
        """B x: (particle,) to slots."""
        return incidence.difference_p.bind(x, *self.tables, layout=self)

    def accumulate(self, f: Array) -> Array:
        """B^T f: slots to (particle,)."""
        return incidence.accumulate_p.bind(f, *self.tables, layout=self)

    @abc.abstractmethod
    def _difference(self, x: Array, *tables: Array) -> Array:
        """B x, from these arrays of the tables."""

    @abc.abstractmethod
    def _accumulate(self, f: Array, *tables: Array) -> Array:
        """B^T f, from these arrays of the tables."""


class Shifts(Layout):
    """Edges of constant offset k: slot s of a group holds the edge (s - k, s).

    The two maps and the layout of their slots are those of `jeuler.graphs.laplacian`. What is one number for all edges
    is one array for all groups, of the longest one's length: half the memory traffic of cloth.
    """

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        low, high = edges.min(axis=1), edges.max(axis=1)
        self.particles = particles
        self.offsets: tuple[int, ...] = tuple(int(k) for k in np.unique(high - low))
        groups = []
        for k in self.offsets:
            group = np.full(particles + k, -1, np.int32)
            chosen = high - low == k
            group[high[chosen]] = numbers[chosen]
            groups.append(group)
        self.slot_edges: tuple[np.ndarray, ...] = tuple(groups)

    def central_force(
        self,
        law: Law,
        x: Components,
        v: Components,
        parameters: Sequence[Slots],
        read_again: bool = False,
        box: Components | None = None,
    ) -> list[Array]:
        assert box is None, "edges of periodic space are not laid out so, see Topology.layouts"
        x, v = ([kept(component) for component in y] for y in (x, v))
        squares, approaches = (self.dot_differences(y, x) for y in (x, v))
        values = map(law, squares, approaches, *map(self.by_group, parameters))
        c = [stored(jnp.where(edges < 0, 0, value)) for edges, value in zip(self.slot_edges, values, strict=True)]
        if read_again:  # without this, XLA computes the edges again for each reader: a gradient 2 to 3 times slower
            x = [kept(component) for component in x]
        return [laplacian(c, component, self.offsets) for component in x]

    def dot_differences(self, x: Sequence[Array], y: Sequence[Array]) -> list[Array]:
        """(B x).(B y), one array a group."""
        by_component = (products(a, b, self.offsets) for a, b in zip(x, y, strict=True))
        return [total(group) for group in zip(*by_component, strict=True)]

    def to_slots(self, x: Array) -> Slots:
        return jnp.broadcast_to(x, self.particles + max(self.offsets)) if x.ndim == 0 else super().to_slots(x)

    def by_group(self, parameter: Slots) -> list[Array]:
        if isinstance(parameter, list):
            return parameter
        return [parameter[: self.particles + k] for k in self.offsets]


LONGEST_ROW = 32  # slots that one row looks up; a particle that meets more edges has several rows
GROUP_COST = 500  # slots that one more group of rows costs in overhead,
GROUP_SHARE = 1 / 60  # and at least this share of all, so that the program stays short
MOST_TURNS = 100  # of edges from one owner to the other; a mesh needs 30
FURTHER_COST = 16  # slots that an extra row of a particle costs, as its sum is scattered


class Rows(Indexed):
    """Any graph: each edge has one slot, in the row of the one end that owns it; the other end looks it up.

        row 7 owns    (7, 2) (7, 9) (7, 30)  -       B x:    x7 - x2, x7 - x9, x7 - x30, 0
        row 7 meets   (4, 7) (11, 7)                 B^T f:  the sum of row 7, minus f in the slots (4, 7) and (11, 7)

    Owners are chosen so that all particles own about equally many edges: a few columns (column, row) then hold nearly
    all edges, with few empty slots, and loops run over all the rows. A particle with more edges than columns gets extra
    rows. The edges that a particle meets are as uneven as its degree: their tables are in groups of like length.
    Rows go by group, in it in reverse Cuthill-McKee order, and the slots of a row in the order of the far ends: what
    a column looks up lies near what it looked up before.

    An edge takes one gathered load a component in B, one in B^T, each with its index, and no scatter. Held in the rows
    of both ends, as one might, it takes two in B, none in B^T, but all arithmetic and all plain loads twice: for
    springs in 3-D 12 gathers instead of 9, and 2 square roots and 4 divisions instead of half; in the gradient 18
    instead of 15.
    """

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        self.particles = particles
        owner, other = evenly_owned(edges, particles)
        owned, met = (np.bincount(ends, minlength=particles) for ends in (owner, other))

        # A row for each particle that has edges, and a last one of empty slots: its sum is that of particles without
        # edges, and its slots are read by those that meet fewer edges than others of their group.
        order = near_order(edges, particles)
        order = order[(owned + met)[order] > 0]
        length = np.clip(met[order], 1, LONGEST_ROW)
        widths = group_widths(length)
        group = np.searchsorted(widths, length)
        order = order[np.argsort(group, kind="stable")]
        sizes = np.bincount(group)
        sizes[-1] += 1
        empty = len(order)
        place = np.full(particles, empty)
        place[order] = np.arange(len(order))

        # Own edges of each row.
        owner, other = place[owner], place[other]
        by = np.lexsort((other, owner))
        owner, other, numbers = owner[by], other[by], numbers[by]
        columns = columns_for(owned[order])
        row, column, further = in_rows(owner, empty + 1, columns)
        far = np.tile(np.arange(empty + 1 + len(further)), (columns, 1))  # a particle itself, in an empty slot
        far[column, row] = other
        edge = np.full(far.shape, -1, np.int32)
        edge[column, row] = numbers
        self.slot_edges: tuple[np.ndarray, ...] = (edge,)

        # Edges that each row looks up.
        by = np.argsort(other, kind="stable")
        slot = (column * far.shape[1] + row)[by]
        row, column, meets_further = in_rows(other[by], empty + 1, LONGEST_ROW)
        meets_further = np.append(meets_further, [empty, empty])  # at least two, see _accumulate
        meets = np.full((LONGEST_ROW, empty + 1 + len(meets_further)), empty)
        meets[column, row] = slot
        ends = np.cumsum(sizes)
        met_tables = [meets[:w, end - size : end] for w, size, end in zip(widths, sizes, ends, strict=True)]

        own = np.concatenate([order, order[:1], order[further]])
        more = np.concatenate([further, meets_further])
        tables = (own, place, far, more, meets[:, empty + 1 :], *met_tables)
        self.tables: tuple[np.ndarray, ...] = tuple(np.ascontiguousarray(table, np.int32) for table in tables)

    def _difference(self, x, *tables):
        own, _, far = tables[:3]
        x = take(x, own)
        return x[..., None, :] - take(x, far)

    def _accumulate(self, f, *tables):
        _, place, _, more, meets_more, *meets = tables
        # XLA would fuse what f is made of into its gathers: one more gather for each factor.
        f = as_stored(f)
        flat = f.reshape(*f.shape[:-2], -1)
        given = sum_of_columns(f)
        met = jnp.concatenate([sum_of_columns(take(flat, table)) for table in meets], axis=-1)
        rows = met.shape[-1]
        rest = jnp.concatenate([given[..., rows:], -sum_of_columns(take(flat, meets_more))], axis=-1)
        # Few rows, often none but the empty one, twice. Nothing fuses with a scatter of two: this one keeps XLA from
        # working out all sums inside the last gather, one at a time.
        total = (given[..., :rows] - met).at[..., more].add(rest, mode="promise_in_bounds")
        return take(total, place)


class Pairs(Indexed):
    """Few edges, as one would write it: a slot an edge, two gathers in B, two scatters in B^T.

    As many slots as edges, no padding, and the shortest program. 46 edges take half as long as in `Rows`; 164 as long;
    866 springs 10.5 instead of 6.4 ns each and 26 instead of 21 with the gradient, in a batch of 32 11 instead of 9.5
    and 45 instead of 41.
    """

    def __init__(self, edges: np.ndarray, numbers: np.ndarray, particles: int) -> None:
        self.particles = particles
        self.slot_edges: tuple[np.ndarray, ...] = (np.asarray(numbers, np.int32),)
        self.tables: tuple[np.ndarray, ...] = (np.ascontiguousarray(edges[:, 0]), np.ascontiguousarray(edges[:, 1]))

    def _difference(self, x, *tables):
        i, j = tables
        return take(x, i) - take(x, j)

    def _accumulate(self, f, *tables):
        i, j = tables
        total = jnp.zeros((*f.shape[:-1], self.particles), f.dtype)
        total = total.at[..., i].add(f, mode="promise_in_bounds")
        return total.at[..., j].add(-f, mode="promise_in_bounds")


def take(x: Array, index: Array) -> Array:
    """x at index along its last axis; indices are known to be in range, which spares the program a check of
    each."""
    return x.at[..., index].get(mode="promise_in_bounds")


def sum_of_columns(x: Array) -> Array:
    """The sum of each row, x being (..., column, row)."""
    return total(x[..., column, :] for column in range(x.shape[-2]))


def evenly_owned(edges: np.ndarray, particles: int) -> tuple[np.ndarray, np.ndarray]:
    """The edges as (owner, other), such that particles own about equally many.

    At first the end with less edges owns; then edges turn round, all at once but for one in and one out of a particle,
    while that takes from one who owns at least two more. The sum of squares falls each time.
    """
    degree = np.bincount(edges.ravel(), minlength=particles)
    turned = degree[edges[:, 0]] > degree[edges[:, 1]]
    owner, other = np.where(turned, edges[:, ::-1].T, edges.T)
    for _ in range(MOST_TURNS):
        owned = np.bincount(owner, minlength=particles)
        turn = np.flatnonzero(owned[owner] > owned[other] + 1)
        for end in (owner, other):
            turn = turn[np.unique(end[turn], return_index=True)[1]]
        if not len(turn):
            break
        owner[turn], other[turn] = other[turn], owner[turn]
    return owner, other


def in_rows(key: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Items sorted by key, the first of key k in row k, others in rows from ``rows`` on: row and column of each item,
    and the keys of the further rows."""
    count = np.bincount(key, minlength=rows)
    rank = np.arange(len(key)) - np.repeat(np.cumsum(count) - count, count)
    more = np.maximum(-(-count // columns) - 1, 0)
    start = rows + np.cumsum(more) - more
    row = np.where(rank < columns, key, start[key] + rank // columns - 1)
    return row, rank % columns, np.repeat(np.arange(rows), more)


def columns_for(owned: np.ndarray) -> int:
    """The number of columns that costs least, given how many edges each particle owns."""
    widths = np.arange(1, max(2, min(owned.max(), LONGEST_ROW) + 1))
    rows = np.array([np.maximum(-(-owned // width), 1).sum() for width in widths])
    return int(widths[np.argmin(widths * rows + FURTHER_COST * (rows - len(owned)))])


def near_order(edges: np.ndarray, particles: int) -> np.ndarray:
    """The particles in an order that puts joined ones near each other.

    Source: E. Cuthill, J. McKee, Reducing the bandwidth of sparse symmetric matrices, 1969; reversed, by SciPy.
    """
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
