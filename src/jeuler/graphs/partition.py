"""Particles in strips, one a device: whose each is, and which of them a strip must know of the others. No physics.

The particles are put in an order in which those that act on each other are near, and the order is cut into strips of
equal length. Reverse Cuthill-McKee makes such an order; the one that the particles have is taken where it sends less.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from jeuler._core.component import component
from jeuler.graphs.layouts import near_order


@component(static=("strips", "size", "hops"))
class Partition:
    """Particles and groups of particles (pairs, triples) by strips; place r of the order is row r % size of r // size.

    A strip computes every group that holds one of its particles, so that no force is sent, and has a ghost for each
    other particle in these groups.

    Attributes:
      strips: their number.
      size: particles of a strip; the last ones are filled up.
      hops: the distances h, from a strip to another, over which particles are sent.
      order: (particle,), the particle at each place; None where each has the place of its number.
      back: (particle,), the place of each particle; None as above.
      sends: for each hop, (strip, most), the rows that a strip sends to the one h further on; filled up with row 0.
      which: for each array of groups, (strip, most), the number of each group.
      rows: for each, (strip, k, most), the rows of its k particles: own ones, then ghosts in the order of the hops.
      targets: as ``rows``, and ``size``, which is no row, for ghosts and in what is filled up.
    """

    strips: int
    size: int
    hops: tuple[int, ...]
    order: Any
    back: Any
    sends: tuple[Any, ...]
    which: tuple[Any, ...]
    rows: tuple[Any, ...]
    targets: tuple[Any, ...]

    def sent(self) -> int:
        """How many particles all strips together send in one exchange, with what is filled up."""
        return sum(rows.shape[1] * (self.strips - abs(h)) for h, rows in zip(self.hops, self.sends, strict=True))


@functools.lru_cache(maxsize=16)
def partition(groups: tuple[Any, ...], particles: int, strips: int) -> Partition:
    """The `Partition` of so many particles with these groups, each integers (group, k), over so many strips."""
    arrays = [np.asarray(one, np.int64) for one in groups]
    size = -(-particles // strips)
    as_given = np.arange(particles)
    joined = [one[:, k : k + 2] for one in arrays for k in range(one.shape[1] - 1)]
    orders = [as_given, near_order(np.concatenate(joined), particles)] if strips > 1 and joined else [as_given]
    return min((_cut(arrays, order, size, strips) for order in orders), key=Partition.sent)


def _cut(groups: list[np.ndarray], order: np.ndarray, size: int, strips: int) -> Partition:
    """The order cut into strips."""
    particles = len(order)
    place = np.empty(particles, np.int64)
    place[order] = np.arange(particles)
    owner = place // size

    # (strip, place of a particle of another one that it needs), as one number, so sorted by strip and place
    columns = range(max((one.shape[1] for one in groups), default=0))
    needed = [
        (owner[one[:, a]] * particles + place[one[:, b]])[owner[one[:, a]] != owner[one[:, b]]]
        for one in groups
        for a in columns[: one.shape[1]]
        for b in columns[: one.shape[1]]
        if a != b
    ]
    ghosts = np.unique(np.concatenate([np.zeros(0, np.int64), *needed]))
    strip, at = np.divmod(ghosts, particles)
    hop, row = strip - at // size, np.empty(len(ghosts), np.int64)
    hops, sends, first = np.unique(hop), [], size
    for h in hops:
        here = np.flatnonzero(hop == h)
        numbers, most = _numbered(strip[here], strips)
        send = np.zeros((strips, most), np.int32)
        send[strip[here] - h, numbers] = at[here] % size
        row[here] = first + numbers
        first += most
        sends.append(send)

    which, rows, targets = [], [], []
    for one in groups:
        pairs = np.unique(np.concatenate([owner[x] * len(one) + np.arange(len(one)) for x in one.T]))
        strip, group = np.divmod(pairs, max(len(one), 1))
        numbers, most = _numbered(strip, strips)
        own = owner[one[group]] == strip[:, None]
        ghost = np.searchsorted(ghosts, strip[:, None] * particles + place[one[group]])
        local = np.where(own, place[one[group]] % size, np.append(row, 0)[ghost])
        numbered = np.zeros((strips, most), np.int32)
        numbered[strip, numbers] = group
        rows.append(np.zeros((strips, one.shape[1], most), np.int32))
        targets.append(np.full((strips, one.shape[1], most), size, np.int32))
        rows[-1][strip, :, numbers] = local
        targets[-1][strip, :, numbers] = np.where(own, local, size)
        which.append(numbered)
    as_given = np.array_equal(order, np.arange(particles))
    tables = tuple(sends), tuple(which), tuple(rows), tuple(targets)
    return Partition(
        strips, size, tuple(map(int, hops)), None if as_given else order, None if as_given else place, *tables
    )


def _numbered(strip: np.ndarray, strips: int) -> tuple[np.ndarray, int]:
    """The number of each entry within its strip, for strips in rising order, and the most that one has."""
    counts = np.bincount(strip, minlength=strips)
    return np.arange(len(strip)) - np.repeat(np.cumsum(counts) - counts, counts), int(counts.max(initial=0))
