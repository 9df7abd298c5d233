"""Pairs within a distance, by a list of cells of fixed capacity: rows of neighbours, and how many found no place."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

NONE = -1  # no neighbour in this place of a row
NOT_BUILT = -2  # in a row that was never filled
PRIMES = (73856093, 19349663, 83492791)


def nearest_image(d: Array, box: Array | None) -> Array:
    """A difference (..., dim), or that to the nearest image in a periodic box (dim,)."""
    return d if box is None else d - box * jnp.round(lax.stop_gradient(d / box))


def rows_of_neighbours(
    x: Array, alive: Array | None, reach: Array, capacity: int, cell_capacity: int, box: Array | None
) -> tuple[Array, Array]:
    """Who is within reach of whom: (particle, capacity), indices in no order and NONE; and the number left out.

    Space is cut into cells of at least that size, found by a hash of their integer coordinates: the neighbours of a
    particle are in its own and the 3^dim - 1 cells around it. Of a cell at most cell_capacity particles are looked at.

    Source: M. Teschner et al., Optimized Spatial Hashing for Collision Detection of Deformable Objects, VMV 2003.
    """
    particles, dim = x.shape
    alive = jnp.ones(particles, bool) if alive is None else alive
    alive = alive & jnp.all(jnp.isfinite(x), axis=1)
    cells, count = _cells(x, reach, box)
    buckets = 1 << int(np.ceil(np.log2(2 * particles + 2)))
    bucket = jnp.where(alive, _hash(cells, buckets), buckets)
    order = jnp.argsort(bucket).astype(jnp.int32)
    size = jnp.zeros(buckets + 1, jnp.int32).at[bucket].add(1)
    start = jnp.cumsum(size, dtype=jnp.int32) - size
    around = cells[:, None] + jnp.asarray(list(itertools.product((-1, 0, 1), repeat=dim)), jnp.int32)
    at = _hash(around if count is None else around % count, buckets)
    at = jnp.where(_is_repeated(at) | ~alive[:, None], buckets, at)  # two cells of one hash are one bucket
    size = size.at[buckets].set(0)
    lost = jnp.sum(jnp.maximum(size[at] - cell_capacity, 0), dtype=jnp.int32)
    by_bucket, components = [x[:, k][order] for k in range(dim)], [x[:, k] for k in range(dim)]
    lanes = jnp.arange(min(cell_capacity, 32), dtype=jnp.int32)

    def look(_, first_and_size):
        """Who of up to 32 particles that lie one after the other is near: a bit for each."""
        first, many = first_and_size
        place = first[:, None] + lanes
        square = jnp.zeros(place.shape, x.dtype)
        for k in range(dim):
            d = by_bucket[k][jnp.minimum(place, particles - 1)] - components[k][:, None]
            d = nearest_image(d, None if box is None else box[k])
            square = square + d * d
        near = (lanes < many[:, None]) & (square < reach * reach)
        return None, jnp.sum(near.astype(jnp.uint32) << lanes.astype(jnp.uint32), axis=1, dtype=jnp.uint32)

    pieces = range(0, cell_capacity, 32)
    first = jnp.concatenate([start[at] + piece for piece in pieces], axis=1)
    many = jnp.concatenate([jnp.clip(jnp.minimum(size[at], cell_capacity) - piece, 0, 32) for piece in pieces], axis=1)
    _, words = lax.scan(look, None, (first.T, many.T))
    place, filled = _set_bits(words.T, first, capacity + 1)  # one more: itself is among them
    who = jnp.where(place >= 0, order[jnp.maximum(place, 0)], NONE)
    own = jnp.argmax(who == jnp.arange(particles)[:, None], axis=1)  # its place is given to the last one
    last = who[:, capacity]
    rows = jnp.where(jnp.arange(capacity) == own[:, None], last[:, None], who[:, :capacity])
    rows = jnp.where(alive[:, None], rows, NONE)
    return rows, lost + jnp.sum(jnp.maximum(filled - 1 - capacity, 0), dtype=jnp.int32)


def _is_repeated(at: Array) -> Array:
    """Whether a number stands farther to the left in its row too."""
    repeated = [jnp.zeros(len(at), bool)]
    for k in range(1, at.shape[1]):
        repeated.append(jnp.any(at[:, :k] == at[:, k, None], axis=1))
    return jnp.stack(repeated, axis=1)


def _set_bits(words: Array, first: Array, count: int) -> tuple[Array, Array]:
    """The places of the first ``count`` set bits of each row of words, -1 past the last; and how many are set.

    The n-th set bit of a word is found by halves, counting the bits in them.
    """
    in_word = lax.population_count(words).astype(jnp.int32)
    up_to = jnp.cumsum(in_word, axis=1, dtype=jnp.int32)
    rank = jnp.arange(count, dtype=jnp.int32)
    word = jnp.sum(up_to[:, None, :] <= rank[:, None], axis=2, dtype=jnp.int32)
    there = word < words.shape[1]
    word = jnp.minimum(word, words.shape[1] - 1)
    bits = jnp.take_along_axis(words, word, axis=1)
    left = rank - jnp.take_along_axis(up_to - in_word, word, axis=1)
    lane = jnp.zeros_like(word)
    for half in (16, 8, 4, 2, 1):
        low = (bits >> lane.astype(jnp.uint32)) & jnp.uint32((1 << half) - 1)
        below = lax.population_count(low).astype(jnp.int32)
        beyond = left >= below
        left, lane = jnp.where(beyond, left - below, left), jnp.where(beyond, lane + half, lane)
    return jnp.where(there, jnp.take_along_axis(first, word, axis=1) + lane, -1), up_to[:, -1]


def _cells(x: Array, reach: Array, box: Array | None) -> tuple[Array, Array | None]:
    """Integer coordinates of each particle's cell; and how many there are along each axis of a periodic box."""
    if box is None:
        return jnp.floor(jnp.where(jnp.isfinite(x), x, 0) / reach).astype(jnp.int32), None
    count = jnp.maximum(jnp.floor(box / reach), 1).astype(jnp.int32)
    share = x / box - jnp.floor(x / box)
    return jnp.minimum((jnp.where(jnp.isfinite(share), share, 0) * count).astype(jnp.int32), count - 1), count


def _hash(cells: Array, buckets: int) -> Array:
    """A bucket for each cell."""
    mixed = jnp.zeros(cells.shape[:-1], jnp.uint32)
    for k in range(cells.shape[-1]):
        mixed = mixed ^ (cells[..., k].astype(jnp.uint32) * jnp.uint32(PRIMES[k % 3] + 2 * (k // 3)))
    mixed = mixed ^ (mixed >> 15)
    return (mixed & jnp.uint32(buckets - 1)).astype(jnp.int32)
