"""Particles by their indices, fixed while tracing; joined in pairs, and the two linear maps from one to the other."""

from __future__ import annotations

import functools
import hashlib
import weakref
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.indices import Indices
from jeuler.graphs.cells import nearest_image
from jeuler.graphs.layouts import Layout, Pairs, Rows, Shifts

MOST_GROUPS = 32  # offsets that get a group of their own: the length of the program, not its speed, sets this
SHIFT_GAIN = 4  # how many slots of Shifts cost what one edge costs in Rows
FEW = 8  # Pairs for less than one edge in so many particles,
MANY = 500  # and for less than so many edges: a scatter of so few costs less than the many kernels of Rows


class Topology(Indices):
    """The edges of a scene, (spring, 2).

    The signed incidence operator B takes a value at each particle to its difference along each edge e = (i, j),

        (B x)_e = x_i - x_j

    Its transpose sums what each edge gives to its two ends, +f at i and -f at j.
    """

    def __init__(self, edges: Any) -> None:
        edges = checks.integers("edges", edges, "integers of shape (spring, 2), particle indices")
        edges = edges if edges.size else np.zeros((0, 2), np.int32)
        if edges.ndim != 2 or edges.shape[1] != 2:
            hint = "; turn it round, edges.T" if edges.ndim == 2 and edges.shape[0] == 2 else ""
            raise ValueError(f"edges must have shape (spring, 2), got {edges.shape}{hint}")
        loops = np.flatnonzero(edges[:, 0] == edges[:, 1])
        if loops.size:
            raise ValueError(
                f"edges must join two different particles, got edges[{loops[0]}] = {edges[loops[0]].tolist()}; "
                f"take that edge out"
            )
        super().__init__(edges)

    def check(self, particles: int) -> None:
        """Every edge joins particles that exist."""
        out_of_range = np.flatnonzero((self.indices >= particles).any(axis=1))
        if out_of_range.size:
            first = out_of_range[0]
            raise ValueError(
                f"edges must be indices below the number of particles, {particles}, "
                f"got edges[{first}] = {self[first].tolist()}"
            )

    def layouts(self, particles: int, shifts: bool = True) -> tuple[Layout, ...]:
        """The edges laid out in memory for the fastest kernels, each edge in one layout; made once and kept.

        The rule: an offset k = |i - j| gets a group of `Shifts` if its edges would cost more in `Rows`, that is if
        there are more than (particles + k) / SHIFT_GAIN of them, at most MOST_GROUPS offsets, the commonest first. The
        other edges are `Pairs` if there are fewer than MANY of them, or than one in FEW particles, else `Rows`. Without
        ``shifts`` all are these: in periodic space a difference is not that of two shifted arrays.
        """
        return _layouts(self, particles, shifts)

    def difference(self, x: Array, box: Array | None = None) -> Array:
        """B x: (particle, dim) to (spring, dim); to the nearest image in a periodic box (dim,)."""
        return nearest_image(x[self[:, 0]] - x[self[:, 1]], box)

    def accumulate(self, force: Array, particles: int) -> Array:
        """B^T f: (spring, dim) to (particle, dim)."""
        total = jnp.zeros((particles, *force.shape[1:]), force.dtype)
        return total.at[self[:, 0]].add(force).at[self[:, 1]].add(-force)


def topology(edges: Any) -> Topology:
    """The `Topology` of these edges: the one made before of the same, while something holds it."""
    if isinstance(edges, Topology):
        return edges
    if isinstance(edges, (list, np.ndarray)):
        try:
            array = np.asarray(edges)
        except (TypeError, ValueError):  # rows of several lengths, or traced: told by what follows
            return Topology(edges)
        if array.dtype.kind in "iu":
            key = array.shape, array.dtype, hashlib.sha1(array.tobytes()).digest()
            made = _made.get(key)
            if made is None:
                made = _made[key] = Topology(array)
            return made
    return Topology(edges)


_made: weakref.WeakValueDictionary[Any, Topology] = weakref.WeakValueDictionary()


@functools.lru_cache(maxsize=64)
def _layouts(topology: Topology, particles: int, shifts: bool) -> tuple[Layout, ...]:
    edges, numbers = topology.indices, np.arange(len(topology))
    if not len(edges):
        return ()
    offset = np.abs(edges[:, 1] - edges[:, 0])
    offsets, counts = np.unique(offset, return_counts=True)
    worth = shifts & (SHIFT_GAIN * counts > particles + offsets)
    commonest = np.argsort(-counts[worth], kind="stable")[:MOST_GROUPS]
    regular = np.isin(offset, offsets[worth][commonest]) & _first_of_its_kind(edges)
    others = ~regular
    layouts: list[Layout] = []
    if regular.any():
        layouts.append(Shifts(edges[regular], numbers[regular], particles))
    if others.any():
        kind = Pairs if np.count_nonzero(others) < max(MANY, particles / FEW) else Rows
        layouts.append(kind(edges[others], numbers[others], particles))
    return tuple(layouts)


def _first_of_its_kind(edges: np.ndarray) -> np.ndarray:
    """Whether no earlier edge joins the same two particles."""
    _, first = np.unique(np.sort(edges, axis=1), axis=0, return_index=True)
    out = np.zeros(len(edges), bool)
    out[first] = True
    return out
