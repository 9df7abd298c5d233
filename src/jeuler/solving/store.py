"""A long run on disk: its saved frames in a zarr store, and its last state in a file that is replaced as a whole.

    path/frames.zarr      t and each part of what is saved, (frame, ...); NaN in frames that are still to come
    path/state.npz        what the next step starts from, and what run it is

An ensemble likewise: its results in ``results.zarr``, (member, ...), and what its reducers have behind them.

Zarr and not HDF5: a chunk is a file of its own that is replaced as a whole, so that a process that is killed leaves
nothing half written, and another process can read while the run goes on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import re
import zipfile
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PyTree = Any
STATE, VERSION = "state.npz", 1


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a folder keeps, in the words of its files and messages."""

    file: str
    row: str
    counted: str
    depends_on: str


RUN = Kind(
    file="frames.zarr",
    row="frame",
    counted="steps",
    depends_on="scene or field, start, dt, t0, key, step, save, save_every",
)


class StoredArray:
    """An array on disk: what is indexed is read, as a NumPy array; NumPy and jax.numpy read all of it."""

    def __init__(self, array: Any, shape: tuple[int, ...]) -> None:
        self.array: Any = array
        self.shape: tuple[int, ...] = shape
        self.dtype: Any = np.dtype(array.dtype)
        self.ndim: int = len(shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> Any:
        index = index if isinstance(index, tuple) else (index,)
        first = index[0]
        if isinstance(first, slice):
            return self.array[slice(*first.indices(len(self))), *index[1:]]
        if not isinstance(first, int):
            return np.asarray(self)[index]
        if not -len(self) <= first < len(self):
            raise IndexError(f"frame {first} is out of range, there are {len(self)}")
        return np.asarray(self.array[first % len(self), *index[1:]])

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.array[: len(self)], dtype)

    def __jax_array__(self) -> jax.Array:
        return jnp.asarray(np.asarray(self))

    def __repr__(self) -> str:
        return f"StoredArray({self.dtype.name}{list(self.shape)})"


class Store:
    """The folder of one run."""

    def __init__(self, path: Any, fingerprint: str, kind: Kind = RUN) -> None:
        self.path, self.fingerprint, self.kind = pathlib.Path(os.fsdecode(path)), fingerprint, kind
        self.arrays: list[Any] = []
        self.kept: int = -1  # steps, or members, that the state on disk has behind it; -1 where there is none

    def last(self, like: PyTree) -> tuple[PyTree, dict[str, int]] | None:
        """The state that was written last, of this form, and its numbers; None where the run is to begin."""
        if not self.path.exists():
            return None
        if not self.path.is_dir():
            raise ValueError(f"resume={str(self.path)!r} is a file; give the path of a folder, which is made")
        if not (self.path / STATE).exists():
            others = [x.name for x in self.path.iterdir() if x.name != self.kind.file and not x.name.startswith(STATE)]
            if others:
                raise ValueError(
                    f"resume={str(self.path)!r} is a folder of something else, it holds {sorted(others)[0]!r}; "
                    f"give the path of a new folder"
                )
            return None
        try:
            with open(self.path / STATE, "rb") as opened, np.load(opened) as file:  # NumPy leaves a broken one open
                about = json.loads(str(file["about"]))
                leaves = [file[f"leaf{n}"] for n in range(about["leaves"])]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{self.path / STATE} cannot be read ({error}); its {self.kind.row}s are in "
                f"{self.path / self.kind.file}; move the folder away to begin anew"
            ) from error
        forms = [(x.shape, x.dtype) for x in jax.tree.leaves(like)]
        if about.get("fingerprint") != self.fingerprint or [(x.shape, x.dtype) for x in leaves] != forms:
            raise ValueError(
                f"resume={str(self.path)!r} holds another run: another {self.kind.depends_on} or version of JAX; "
                f"give another path"
            )
        self.kept = about["steps"]
        return jax.tree.unflatten(jax.tree.structure(like), leaves), about

    def open(self, frame: PyTree, labels: Sequence[str], rows: int, frames: int) -> None:
        """The arrays on disk for frames of this form, with a name each, as many, made where they are not there;
        ``rows`` in a chunk."""
        import zarr

        place = self.path / self.kind.file
        with self.errors():
            self.path.mkdir(parents=True, exist_ok=True)
            if self.kept >= 0:
                try:
                    group = zarr.open_group(place, mode="r+")
                    self.arrays = [group[name] for name in labels]
                except (KeyError, FileNotFoundError, ValueError) as error:
                    raise ValueError(f"{place} cannot be read ({error}); move the folder away to begin anew") from None
                for array in self.arrays:
                    if array.shape[0] < frames:
                        array.resize((frames, *array.shape[1:]))
                return
            group = zarr.open_group(place, mode="w")
            self.arrays = [
                group.create_array(
                    name,
                    shape=(frames, *x.shape),
                    chunks=(rows, *(max(1, size) for size in x.shape)),
                    dtype=x.dtype,
                    fill_value=np.nan if np.issubdtype(x.dtype, np.inexact) else 0,
                    dimension_names=(self.kind.row, *(f"{name}_{n}" for n in range(len(x.shape)))),
                )
                for name, x in zip(labels, jax.tree.leaves(frame), strict=True)
            ]

    def write(self, place: int, frames: PyTree, count: int) -> None:
        """These first frames, ``count``, from that place on."""
        with self.errors():
            for array, x in zip(self.arrays, jax.tree.leaves(frames), strict=True):
                array[place : place + count] = np.asarray(x)[:count]  # to slice on the device compiles for each count

    def keep(self, state: PyTree, steps: int, **numbers: int) -> None:
        """The state after so many steps, in place of the one before: one or the other is there at each moment."""
        leaves: dict[str, Any] = {f"leaf{n}": np.asarray(x) for n, x in enumerate(jax.tree.leaves(state))}
        about = {"version": VERSION, "fingerprint": self.fingerprint, "leaves": len(leaves), "steps": steps, **numbers}
        part = self.path / f"{STATE}.part"
        with self.errors():
            self.path.mkdir(parents=True, exist_ok=True)
            try:
                with open(part, "wb") as file:
                    np.savez(file, about=json.dumps(about), **leaves)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(part, self.path / STATE)
            finally:
                part.unlink(missing_ok=True)
        self.kept = steps

    def frames(self, frame: PyTree, count: int) -> PyTree:
        """The first frames, each array read when it is asked for."""
        arrays = [StoredArray(array, (count, *array.shape[1:])) for array in self.arrays]
        return jax.tree.unflatten(jax.tree.structure(frame), arrays)

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """An error of the disk says what is kept."""
        try:
            yield
        except OSError as error:
            kept = (
                f"the state after {self.kept:,} {self.kind.counted} is kept there"
                if self.kept >= 0
                else "no state is kept there yet"
            )
            message = f"{self.path} cannot be written ({error.strerror or error}); {kept}; make place and call it again"
            raise OSError(error.errno, message) from error


def names(tree: PyTree, first: tuple[str, ...] = ()) -> list[str]:
    """The names of the arrays of a frame, after these first ones: the paths of its parts."""
    found = list(first)
    for path, _ in jax.tree_util.tree_leaves_with_path(tree):
        name = re.sub(r"\W+", "_", jax.tree_util.keystr(path)).strip("_") or "y"
        found.append(name if name not in found else f"{name}_{len(found)}")
    return found
