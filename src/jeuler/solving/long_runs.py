"""A run that survives: its frames go to disk as they come, its last state too, and the same call goes on from there."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jeuler._core import checks
from jeuler._core.component import replace
from jeuler._jax import programs
from jeuler.solving.chunks import EPOCH, FEWEST, Progress, Sizes, _begin, _chunk, _telling
from jeuler.solving.grid import Grid
from jeuler.solving.loop import Loop
from jeuler.solving.store import Store, names

PyTree = Any
BUFFER = 2**22  # bytes of frames that wait for the disk,
MOST_ROWS = 4096  # as many at most
MOST_DRAWS = 2**32 - 1  # steps with random numbers of their own: a key is folded with 32 bits
SECONDS = 10.0  # between two states on disk, where the user does not say


def check_resume(resume: Any, checkpoint_every: Any, checkpoint: Any, frames: bool = True) -> None:
    """One ValueError if the run cannot be kept on disk, with frames or without."""
    if resume is None:
        if checkpoint_every is not None:
            raise ValueError('checkpoint_every needs resume, a folder to keep the state in; write resume="run"')
        return
    if not isinstance(resume, (str, bytes)) and not hasattr(resume, "__fspath__"):
        raise ValueError(f'resume must be the path of a folder, got {checks.shown(resume)}; write resume="run"')
    if checkpoint_every is not None:
        checks.count("checkpoint_every", checkpoint_every, least=1)
    if programs.is_transformed():
        raise ValueError("resume needs a run outside of jit, vmap and grad, got one inside; leave resume out there")
    if checkpoint == "reversible":
        raise ValueError('resume must be None with checkpoint="reversible", a run in one piece; leave one out')
    try:
        if frames:
            import zarr  # noqa: F401
    except ImportError:
        raise ValueError("resume writes frames with zarr, which is not installed; pip install 'jeuler[runs]'") from None


def run_on_disk(
    loop_of: Callable[..., Loop],
    inputs: tuple[Any, ...],
    settings: tuple[Any, ...],
    grid: Grid,
    resume: Any,
    checkpoint_every: int | None,
    progress: Progress,
) -> tuple[Any, PyTree, Any, Any]:
    """The fields of a `Solution` of ``loop_of(*inputs, *settings)``, from where the folder has it to its end."""
    short = replace(grid, num_steps=0)
    form = jax.eval_shape(lambda: _frame(loop_of, inputs, settings, short))
    rows = int(np.clip(BUFFER // max(1, sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(form))), 1, MOST_ROWS))
    # the program knows of so many frames, whatever the number of steps: a run that goes on has the same program
    buffered = replace(grid, num_steps=rows * grid.save_every if grid.save_every * rows < EPOCH else grid.save_every)
    rows = buffered.num_steps // grid.save_every
    inputs = tuple(buffered if x is grid else x for x in inputs)
    state = programs.prepared(_begin, inputs, (*settings, loop_of))()
    lowered, dynamic = programs.lowered(_chunk, inputs, (*settings, loop_of), state, np.int32(0), grid.t0)
    store = Store(resume, fingerprint(lowered, dynamic))
    return Run(store, lowered.compile(), dynamic, grid, state, rows).to_end(checkpoint_every, progress)


def _frame(loop_of: Callable[..., Loop], inputs: tuple, settings: tuple, short: Grid) -> PyTree:
    loop = loop_of(*(short if isinstance(x, Grid) else x for x in inputs), *settings)
    return loop.saved(loop.first_carry())


def fingerprint(lowered: Any, dynamic: list) -> str:
    """What program it is, with which numbers."""
    digest = hashlib.sha256(lowered.as_text().encode())
    for x in dynamic:
        x = jax.random.key_data(x) if jax.numpy.issubdtype(getattr(x, "dtype", float), jax.dtypes.prng_key) else x
        digest.update(f"{np.shape(x)}{np.asarray(x).dtype}".encode() + np.asarray(x).tobytes())
    return digest.hexdigest()


class Run:
    """A run with its folder. Steps are counted on the host, without bound; on the device within an `EPOCH` of them."""

    def __init__(self, store: Store, compiled: Any, dynamic: list, grid: Grid, state: PyTree, rows: int) -> None:
        self.store, self.compiled, self.dynamic, self.grid, self.rows = store, compiled, dynamic, grid, rows
        self.done: int = 0
        self.base: int = 0  # steps before this epoch
        self.written: int = 0  # frames on disk
        self.first_nonfinite: int = -1
        self.unresolved: int = 0
        carry, self.saved, since, place = state
        self.state: PyTree = (carry, since)
        self.frame: PyTree = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), self.saved)
        self.waiting: int = 1  # frames in the buffer
        self.place: Any = place
        found = store.last(self.state)
        if found is not None:
            self._take_up(*found)

    def _take_up(self, state: PyTree, about: dict[str, int]) -> None:
        self.state = state
        self.done, self.base, self.written = about["steps"], about["base"], about["frames"]
        self.first_nonfinite, self.unresolved = about["first_nonfinite"], about["unresolved"]
        self.waiting, self.place = 0, np.int32(0)

    def to_end(self, checkpoint_every: int | None, progress: Progress) -> tuple[Any, PyTree, Any, Any]:
        """The fields of a `Solution`."""
        grid, total = self.grid, self.grid.num_steps
        paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(self.state)]
        if total > MOST_DRAWS and any(path.endswith(".steps") for path in paths):
            raise ValueError(
                f"num_steps must be at most {MOST_DRAWS:,} in a scene with births or random effects, which would draw "
                f"the same numbers again after these, got {total:,}"
            )
        if self.done > total:
            raise ValueError(
                f"num_steps must be at least {self.done:,}, the steps that the run in {self.store.path} has behind it, "
                f"got {total:,}; read its frames, or give another path"
            )
        labels = names(self.frame[1], ("t",))
        self.store.open(self.frame, labels, self.rows, total // grid.save_every + 1)
        numbers = max(FEWEST, sum(np.size(x) for x in jax.tree.leaves(self.state)))
        sizes = Sizes({}, numbers)
        kept_at = time.perf_counter()
        try:
            with _telling(progress, total) as tell:
                while self.done < total:
                    count = min(sizes.next, total - self.done, self.base + EPOCH - self.done)
                    if checkpoint_every:
                        count = min(count, checkpoint_every - self.done % checkpoint_every)
                    count = min(count, (self.rows - self.waiting) * grid.save_every)
                    start = time.perf_counter()
                    self._advance(count)
                    sizes.measured(count, time.perf_counter() - start)
                    if tell:
                        tell(self.done)
                    now = time.perf_counter()
                    if self.done % checkpoint_every == 0 if checkpoint_every else now - kept_at > SECONDS:
                        self._keep()
                        kept_at = now
        finally:
            # also where Ctrl-C or the bar ended it, unless that was amid a step or the disk is the trouble
            usable = not any(getattr(x, "is_deleted", bool)() for x in jax.tree.leaves((self.state, self.saved)))
            if self.done > self.store.kept and usable and not isinstance(sys.exception(), OSError):
                self._keep()
        t, y = self.store.frames(self.frame, self.written)
        return np.asarray(t), y, np.int64(self.first_nonfinite), np.int32(self.unresolved)

    def _advance(self, count: int) -> None:
        """So many steps on the device; a full buffer goes to disk."""
        carry, since = self.state
        t0 = np.asarray(float(self.grid.t0) + self.base * float(self.grid.dt), self.grid.t0.dtype)
        given = (carry, self.saved, since, self.place), np.int32(self.done - self.base + count), t0
        (carry, self.saved, since, self.place), unresolved = self.compiled(self.dynamic, given[:1], given[1:])
        self.state = carry, since
        self.waiting = int(self.place)
        self.done += count
        self.unresolved = int(unresolved)
        if self.first_nonfinite < 0 <= int(carry[1]):
            self.first_nonfinite = self.base + int(carry[1])
        if self.done == self.base + EPOCH:
            self.base = self.done
            self.state = (np.int32(0), carry[1], carry[2]), since
        if self.waiting == self.rows:
            self._flush()

    def _flush(self) -> None:
        self.store.write(self.written, self.saved, self.waiting)
        self.written += self.waiting
        self.waiting, self.place = 0, np.int32(0)

    def _keep(self) -> None:
        """Frames first: a state on disk has all its frames there."""
        self._flush()
        numbers = {"first_nonfinite": self.first_nonfinite, "unresolved": self.unresolved}
        self.store.keep(self.state, self.done, base=self.base, frames=self.written, **numbers)
