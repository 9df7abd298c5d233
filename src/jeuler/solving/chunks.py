"""A long run from a loop on the host, some steps at a time, so that Ctrl-C stops it and progress can be shown.

One program does any number of steps, so that nothing compiles again from chunk to chunk. It writes the saved states
into the arrays of the `Solution`, whose memory goes from call to call.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.component import replace
from jeuler._core.precision import setting
from jeuler._jax import programs
from jeuler.solving.grid import COUNTER, Grid, check_counter
from jeuler.solving.loop import Loop

PyTree = Any
Progress = bool | Callable[[int, int], Any] | None
Work = float  # numbers times steps

LONG: Work = 1e6  # from here on a run goes in chunks
FIRST: Work = 1e5  # of the first chunk of a program
FEWEST = 32  # a step of fewer numbers takes about as long
SECONDS = 0.1  # of a chunk
EPOCH = 2**30  # steps on one clock where integers have 32 bits


def check_progress(progress: Any, checkpoint: Any) -> None:
    """One ValueError if progress is not a switch or a function of two numbers, or the run cannot tell any."""
    if progress is None or progress is False:
        return
    if progress is not True:
        checks.function("progress", progress, "(step, num_steps)", "progress=True shows a bar")
    if programs.is_transformed():
        raise ValueError("progress needs a run outside of jit, vmap and grad, got one inside; leave progress out there")
    if checkpoint == "reversible":
        raise ValueError('progress must be None with checkpoint="reversible", a run in one piece; leave one out')


def can_be_in_chunks(checkpoint: Any) -> bool:
    """Whether a run with this checkpoint can be done in pieces: not a traced one, nor a reversible one."""
    return not programs.is_transformed() and checkpoint != "reversible" and not setting("jax_disable_jit")


def run_in_chunks(
    loop_of: Callable[..., Loop], inputs: tuple[Any, ...], settings: tuple[Any, ...], grid: Grid, progress: Progress
) -> tuple[Array, PyTree, Any, Any] | None:
    """The fields of a `Solution` of ``loop_of(*inputs, *settings)``, or None for a run that is to be done in one piece.

    That is a short one, one that is being traced, and one that cannot be traced.
    """
    if programs.is_transformed() or (setting("jax_disable_jit") and not progress):
        return None
    numbers = max(FEWEST, sum([getattr(x, "size", 0) for x in jax.tree.leaves(inputs)]))
    if not progress and grid.num_steps * numbers < LONG:
        return None
    try:
        state = programs.prepared(_begin, inputs, (*settings, loop_of))()
        chunk = programs.prepared(_chunk, inputs, (*settings, loop_of))
        with _telling(progress, grid.num_steps) as tell:
            return _run(chunk, state, grid, numbers, tell)
    except (ValueError, *programs.NEEDS_VALUES) as error:
        if not programs.needs_values(error):
            raise
        check_counter(grid.num_steps, grid.save_every)
        return None


def _begin(*given: Any) -> PyTree:
    """What goes from chunk to chunk: the carry, what is saved, the steps since a save and the next one's place."""
    *of_loop, loop_of = given
    loop = loop_of(*of_loop)
    carry = loop.first_carry()
    length = loop.grid.num_steps // loop.grid.save_every + 1

    def array(x):
        x = jnp.asarray(x)
        return jnp.zeros((length, *x.shape), x.dtype).at[0].set(x)

    return carry, jax.tree.map(array, loop.saved(carry)), jnp.int32(0), jnp.int32(1)


def _chunk(*given: Any) -> tuple[PyTree, Any]:
    """What `_begin` made, after the steps up to the ``last`` on a clock that starts at t0; and what is unresolved."""
    *of_loop, loop_of, state, last, t0 = given
    loop = loop_of(*(replace(x, t0=t0) if isinstance(x, Grid) else x for x in of_loop))
    save_every = loop.grid.save_every

    def to_a_save(state):
        carry, saved, since, place = state
        count = jnp.minimum(save_every - since, last - carry[0])
        carry = loop.within(lambda c: lax.fori_loop(0, count, lambda _, c: loop.one_step(c)[0], c), carry)
        # written also where a chunk ends between two saves: the next one writes to the same place
        write = functools.partial(lax.dynamic_update_index_in_dim, index=place, axis=0)
        saved = jax.tree.map(write, saved, loop.saved(carry))
        since = (since + count).astype(jnp.int32)
        full = since == save_every
        return carry, saved, jnp.where(full, 0, since), place + full

    state = lax.while_loop(lambda state: state[0][0] < last, to_a_save, state)
    return state, loop.unresolved_of(state[0])


def _run(chunk: Any, state: PyTree, grid: Grid, numbers: int, tell: Callable[[int], Any] | None) -> tuple:
    """The fields of a `Solution`, of as many chunks as it takes.

    Where integers have 32 bits, each `EPOCH` of steps counts from 0 and has a clock of its own.
    """
    counter = state[0][0].dtype
    epoch = EPOCH if counter == np.int32 and grid.num_steps > COUNTER else grid.num_steps
    done, base = 0, 0
    t0: Any = grid.t0
    first_nonfinite: Any = None
    sizes = Sizes(chunk.notes, numbers)
    while True:
        count = min(sizes.next, grid.num_steps - done, base + epoch - done)
        start = time.perf_counter()
        state, unresolved = chunk(state, np.asarray(done - base + count, counter), t0)
        done += count
        if tell or done < grid.num_steps:
            jax.block_until_ready(unresolved)
            sizes.measured(count, time.perf_counter() - start)
        if tell:
            tell(done)
        if epoch < grid.num_steps and done in (base + epoch, grid.num_steps):
            (_, found, y), *rest = state
            if first_nonfinite is None and found >= 0:
                first_nonfinite = base + int(found)
            base, t0 = done, np.asarray(float(grid.t0) + done * float(grid.dt), grid.t0.dtype)
            state = (np.zeros((), counter), found, y), *rest
        if done == grid.num_steps:
            break
    (_, found, _), (t, y), *_ = state
    if epoch < grid.num_steps:
        found = np.int64(-1 if first_nonfinite is None else first_nonfinite)
    return t, y, found, unresolved


class Sizes:
    """How many steps to do at once, from the time that steps took; known from earlier runs of the same program."""

    def __init__(self, known: dict[int, float], numbers: int) -> None:
        self.known: dict[int, float] = known  # seconds a step, by how many numbers there are
        self.numbers: int = numbers
        self.warm: bool = numbers in known
        self.next: int = max(1, int(SECONDS / known[numbers] if self.warm else FIRST / numbers))

    def measured(self, steps: int, seconds: float) -> None:
        if not self.warm:  # it may have compiled
            self.warm = True
            return
        self.known[self.numbers] = seconds / max(steps, 1)
        self.next = max(1, int(steps * min(SECONDS / max(seconds, 1e-9), 8.0)))


@contextmanager
def _telling(progress: Progress, num_steps: int) -> Iterator[Callable[[int], Any] | None]:
    """What is to be called with the number of steps done, if anything."""
    if callable(progress):
        yield lambda done: progress(done, num_steps)
    elif progress:
        from tqdm.auto import tqdm

        with tqdm(total=num_steps, unit="step", unit_scale=True) as bar:
            yield lambda done: bar.update(done - bar.n)
    else:
        yield None
