"""An ensemble on disk: what its reducers have behind them, which members were lost, and results that are not reduced.

Of several processes the first one writes and reads, and sends to all what it read: they begin with the same batch, and
the folder may be on a disk that the first one alone can see.
"""

from __future__ import annotations

import contextlib
import pickle
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jeuler.solving.store import Kind, Store, names

PyTree = Any
SECONDS = 10.0  # between two states on disk, where the user does not say
MEMBERS = Kind(
    file="results.zarr",
    row="member",
    counted="members",
    depends_on="function, members, reducer, batch, number of devices",
)


class KeptMembers:
    """The folder of one ensemble.

    Attributes:
      done: how many members the state on disk has behind it.
      state: that state, the reducers' and which members were lost; None where the ensemble is to begin.
      due: after how many members the next one is to be written.
    """

    def __init__(self, store: Store, like: PyTree, result: PyTree, count: int, size: int, every: int | None) -> None:
        self.store, self.result, self.count, self.size, self.every = store, result, count, size, every
        found, error = None, None
        if jax.process_index() == 0:
            try:
                found = store.last(like)
                if result is not None:
                    store.open(result, names(result), size, count)
            except (ValueError, OSError) as its:
                error = its
        with self.in_touch():
            leaves, done, error = from_the_first(
                (None, 0, error) if found is None else (jax.tree.leaves(found[0]), found[1]["steps"], error)
            )
        if error is not None:
            raise error
        self.state: PyTree = None if leaves is None else jax.tree.unflatten(jax.tree.structure(like), leaves)
        self.done: int = done
        self.due: int = done + (every or size)
        self.at: float = time.perf_counter()

    def write(self, first: int, results: PyTree, count: int) -> None:
        """The results of a batch, whose members have the numbers from this one on."""
        if jax.process_index() == 0:
            self.store.write(first, results, count)

    def keep(self, state: PyTree, done: int) -> None:
        """The state after so many members; the next one after ``every`` members, or in `SECONDS`."""
        if jax.process_index() == 0:
            self.store.keep(state, done)
        since, seconds = done - self.done, max(time.perf_counter() - self.at, 1e-9)
        ahead = self.every or int(np.clip(since * SECONDS / seconds, 1, 2 * since))
        with self.in_touch():
            self.done, self.due = done, done + from_the_first(ahead)
        self.at = time.perf_counter()

    def results(self) -> PyTree:
        """All results: read from disk when they are asked for, or in each of several processes."""
        if self.result is None:
            return None
        stored = self.store.frames(self.result, self.count) if jax.process_index() == 0 else self.result
        if jax.process_count() == 1:
            return stored
        from jax.experimental import multihost_utils

        def of_the_first(x):
            there = np.asarray(x) if jax.process_index() == 0 else np.zeros((self.count, *x.shape), x.dtype)
            sent = multihost_utils.broadcast_one_to_all(np.ascontiguousarray(there).view(np.uint8))
            return np.asarray(sent).view(x.dtype).reshape(there.shape)

        with self.in_touch():
            return jax.tree.map(of_the_first, stored)

    def in_touch(self) -> contextlib.AbstractContextManager[None]:
        return in_touch(f"what it has is kept in {self.store.path}: start all processes again with the same call")


@contextlib.contextmanager
def in_touch(what_to_do: str) -> Iterator[None]:
    """The error of a process that waits for one that has ended says what to do."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # JAX raises the one or the other
        if jax.process_count() == 1:
            raise
        raise RuntimeError(f"a process of the ensemble has ended, or is out of reach; {what_to_do}") from error


def from_the_first(something: Any) -> Any:
    """What the first of several processes has, in all of them."""
    if jax.process_count() == 1:
        return something
    from jax.experimental import multihost_utils

    written = np.frombuffer(pickle.dumps(something), np.uint8)
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(written))))
    sent = multihost_utils.broadcast_one_to_all(written if jax.process_index() == 0 else np.zeros(size, np.uint8))
    return pickle.loads(np.asarray(sent).tobytes())
