"""The state of a long fit in a file: written whole or not at all, taken up again after a crash."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import time
import zipfile
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.files import check_output, write_atomically

SEARCH, STARTS = "search", "starts"  # the parts of a fit: its search, and before it those from many starts


@dataclasses.dataclass
class Record:
    """The file of a fit, and the mark by which it knows its own.

    Attributes:
      path: of the file.
      mark: of the problem: its residual, its form, its start and its data, and how it is searched.
      found: what the file held when the fit began; None where there was none.
      ends: where the searches from many starts ended, (start, n), and the cost of each, as far as they are there.
      pause: least time between two writes, s; it grows so that writing takes less than a twentieth of the time.
    """

    path: str
    mark: str
    found: dict[str, np.ndarray] | None = None
    ends: tuple[np.ndarray, np.ndarray] | None = None
    pause: float = 0.5
    last: float = -np.inf

    @classmethod
    def of(cls, path: Any, problem: Callable[[], Any]) -> Record | None:
        """A record at this path for a problem made of arrays and of what prints itself; None without a path."""
        if path is None:
            return None
        check_output(path)
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(problem()):
            digest.update(np.asarray(_numbers(leaf)).tobytes() if hasattr(leaf, "dtype") else repr(leaf).encode())
        record = cls(os.fspath(path), digest.hexdigest())
        record.found = record._opened()
        if record.found is not None and "_ends" in record.found:
            record.ends = record.found["_ends"], record.found["_costs"]
        return record

    def save(self, stage: int, state: Any, history: list[float], part: str = SEARCH) -> None:
        """Write where the search is, a pytree of numbers, if the last time is long enough ago."""
        begun = time.monotonic()
        if begun - self.last < self.pause:
            return
        arrays = {str(k): np.asarray(_numbers(leaf)) for k, leaf in enumerate(jax.tree.leaves(state))}
        if self.ends is not None:
            arrays |= {"_ends": self.ends[0], "_costs": self.ends[1]}

        def write(path: str) -> None:
            with open(path, "wb") as file:
                numbers: dict[str, Any] = {"_part": part, "_stage": stage, "_history": np.asarray(history), **arrays}
                np.savez(file, _mark=self.mark, **numbers)

        write_atomically(self.path, write)
        self.last = time.monotonic()
        self.pause = max(0.5, 20 * (self.last - begun))

    def load(self, like: Any, part: str = SEARCH) -> tuple[int, Any, list[float]] | None:
        """Where this part of the fit was, of the structure of ``like``; None if the file has none of it."""
        if self.found is None or str(self.found["_part"]) != part:
            return None
        leaves, structure = jax.tree.flatten(like)
        kept = [self.found[str(k)] for k in range(len(leaves)) if str(k) in self.found]
        shapes = [np.shape(_numbers(leaf)) for leaf in leaves]
        if str(len(leaves)) in self.found or [k.shape for k in kept] != shapes:
            raise ValueError(self._of_another)
        state = jax.tree.unflatten(structure, [_as(leaf, k) for leaf, k in zip(leaves, kept, strict=True)])
        return int(self.found["_stage"]), state, self.found["_history"].tolist()

    @property
    def all_ends(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The ends of all the starts, where the file is past these."""
        return None if self.found is None or str(self.found["_part"]) == STARTS else self.ends

    @property
    def _of_another(self) -> str:
        return (
            f"resume={self.path!r} holds another fit (another residual or optimizer, other data, start, parameters or "
            f"options); give another path, or delete the file"
        )

    def _opened(self) -> dict[str, np.ndarray] | None:
        """What the file holds, or one ValueError; None if there is none yet."""
        if not os.path.exists(self.path) or os.path.getsize(self.path) == 0:
            return None
        try:
            with open(self.path, "rb") as opened, np.load(opened, allow_pickle=False) as kept:
                found = {name: kept[name] for name in kept.files}
            mark = str(found["_mark"])
        except (zipfile.BadZipFile, KeyError, EOFError, OSError, ValueError, AttributeError):
            raise ValueError(f"resume={self.path!r} is not the state of a fit; give another path") from None
        if mark != self.mark or "_part" not in found:
            raise ValueError(self._of_another)
        return found


def _numbers(leaf: Any) -> Any:
    """An array of numbers; those of a key of ``jax.random``."""
    typed = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if typed else leaf


def _as(leaf: Any, kept: np.ndarray) -> Any:
    """Numbers of the kind that a leaf has."""
    if isinstance(leaf, jax.Array):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.asarray(kept), impl=jax.random.key_impl(leaf))
        return jnp.asarray(kept, leaf.dtype)
    return kept.item() if type(leaf) in (bool, int, float) else kept
