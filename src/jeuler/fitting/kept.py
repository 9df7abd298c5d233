"""The state of a long fit in a file: written whole or not at all, taken up again after a crash."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import time
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.files import check_output, write_atomically


@dataclasses.dataclass
class Record:
    """The file of a fit, and the mark by which it knows its own.

    Attributes:
      path: of the file.
      mark: of the problem: its form, its start and its data.
      pause: least time between two writes, s; it grows so that writing takes less than a twentieth of the time.
    """

    path: str
    mark: str
    pause: float = 0.5
    last: float = -np.inf

    @classmethod
    def of(cls, path: Any, *problem: Any) -> Record:
        """A record at this path for a problem made of arrays and of what prints itself."""
        check_output(path)
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(problem):
            digest.update(np.asarray(_numbers(leaf)).tobytes() if hasattr(leaf, "dtype") else repr(leaf).encode())
        return cls(os.fspath(path), digest.hexdigest())

    def save(self, stage: int, state: Any, history: list[float]) -> None:
        """Write where the search is, if the last time is long enough ago."""
        begun = time.monotonic()
        if begun - self.last < self.pause:
            return
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in state._asdict().items()}

        def write(path: str) -> None:
            with open(path, "wb") as file:
                np.savez(file, _mark=self.mark, _stage=stage, _history=np.asarray(history), **arrays)

        write_atomically(self.path, write)
        self.last = time.monotonic()
        self.pause = max(0.5, 20 * (self.last - begun))

    def load(self, kind: Any) -> tuple[int, Any, list[float]] | None:
        """Where the search was, a NamedTuple of this kind, or None if there is no file yet."""
        if not os.path.exists(self.path) or os.path.getsize(self.path) == 0:
            return None
        try:
            with np.load(self.path, allow_pickle=False) as kept:
                if str(kept["_mark"]) != self.mark:
                    raise ValueError(
                        f"resume={self.path!r} holds another fit (other data, start or parameters); "
                        f"give another path, or delete the file"
                    )
                state = kind(**{name: kept[name] for name in kind._fields})
                return int(kept["_stage"]), state, kept["_history"].tolist()
        except (zipfile.BadZipFile, KeyError, EOFError, OSError):
            raise ValueError(f"resume={self.path!r} is not the state of a fit; give another path") from None


def _numbers(leaf: Any) -> Any:
    """An array of numbers; those of a key of ``jax.random``."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
