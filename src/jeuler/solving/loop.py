"""The loop of a run on a grid of times: what a step does, what is kept of a state, and all in one ``lax.scan``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.precision import setting
from jeuler._jax.placed import as_carried
from jeuler.solving.grid import COUNTER, Grid

PyTree = Any


@dataclasses.dataclass(frozen=True)
class Loop:
    """A run before its loop.

    Attributes:
      next_state: ``next_state(n, t, (y, extra))``, the pair after the step that starts at t, the n-th from 0.
      start: the pair (y, extra) before the first step; y is saved.
      grid: when the run steps and saves.
      save: ``save(t, y)`` makes what is kept of a saved state; None keeps y.
      watch: the part of y in which the first number that is not finite is looked for.
      within: ``within(run, carry)`` does what ``run(carry)`` does, some steps, on a part of the carry.
      unresolved: what a run did not resolve, from its last y; None for nothing.
    """

    next_state: Callable[[Array, Array, PyTree], PyTree]
    start: tuple[PyTree, PyTree]
    grid: Grid
    save: Callable[[Array, PyTree], PyTree] | None
    watch: Callable[[PyTree], PyTree] = lambda y: y
    within: Callable[[Callable[[PyTree], PyTree], PyTree], PyTree] = lambda run, carry: run(carry)
    unresolved: Callable[[PyTree], Any] = lambda y: None

    def first_carry(self) -> PyTree:
        """What is carried from step to step, (steps taken, first step that is not finite, (y, extra)), at the start."""
        saved_form(self.save, self.grid.t0, self.start[0])
        counter = jnp.int64 if self.grid.num_steps > COUNTER and setting("jax_enable_x64") else jnp.int32
        return jnp.zeros((), counter), jnp.full((), -1, counter), self.start

    def one_step(self, carry: PyTree, _: Any = None) -> tuple[PyTree, None]:
        return watched(self.next_state, self.grid.clock, self.watch)(carry), None

    def saved(self, carry: PyTree) -> tuple[Array, PyTree]:
        """The time, and what is kept of the state."""
        n, _, (y, _) = carry
        t = self.grid.clock(n)
        return t, (y if self.save is None else self.save(t, y))

    def unresolved_of(self, carry: PyTree) -> Any:
        left = self.unresolved(carry[2][0])
        return jnp.int32(0) if left is None else left


def watched(
    next_state: Callable[..., PyTree], clock: Callable[[Array], Array], watch: Callable[[PyTree], PyTree]
) -> Callable[[PyTree], PyTree]:
    """One step on (number of steps so far, first of them that was not finite, state)."""

    def advance(carry):
        n, first_nonfinite, state = carry
        state = next_state(n, clock(n), state)
        n = n + 1
        newly_nonfinite = (first_nonfinite < 0) & ~trees.all_finite(watch(state[0]))
        return n, jnp.where(newly_nonfinite, n, first_nonfinite), state

    return advance


def in_one_scan(loop: Loop) -> tuple[Array, PyTree, Array, Any]:
    """The fields of a `Solution`: times and states saved, the first step that is not finite, what is unresolved."""
    grid = loop.grid

    def one_save(carry, _):
        carry = loop.within(lambda carry: _scan(loop.one_step, carry, grid.save_every, grid.segment)[0], carry)
        return carry, loop.saved(carry)

    carry = as_carried(lambda carry: loop.one_step(carry)[0], loop.first_carry())
    blocks = None if grid.segment is None else max(1, grid.segment // grid.save_every)
    last, rest = _scan(one_save, carry, grid.num_steps // grid.save_every, blocks)
    t, y = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), loop.saved(carry), rest)
    return t, y, last[1], loop.unresolved_of(last)


def _scan(body: Callable[..., Any], carry: PyTree, count: int, segment: int | None) -> tuple[PyTree, PyTree]:
    """Scan ``body`` count times; with a segment, reverse mode keeps only the carries between segments."""
    if count == 1:  # no loop, and outputs with a leading axis of one
        carry, out = body(carry, None)
        return carry, jax.tree.map(lambda x: jnp.asarray(x)[None], out)
    if segment is None or segment >= count:
        # One step a turn: with four, Euler's method on small problems runs 1.7 times faster, but the gradient of two in
        # three of them 10 to 50 times slower, as XLA on CPU no longer makes one kernel of a turn.
        return lax.scan(body, carry, None, length=count)
    inner = functools.partial(_scan, body, count=segment, segment=None)
    many = jax.checkpoint(lambda carry, _: inner(carry), prevent_cse=False)
    carry, out = lax.scan(many, carry, None, length=count // segment)
    out = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), out)
    if count % segment:
        carry, rest = lax.scan(body, carry, None, length=count % segment)
        out = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), out, rest)
    return carry, out


def saved_form(save: Callable[..., Any] | None, t: Array, y: PyTree) -> None:
    """One ValueError if what save keeps of a state is not made of arrays."""
    if save is None:
        return
    kept = checks.form_of("save", save, t, y)
    if not jax.tree.leaves(kept):
        raise ValueError("save must return arrays, what is kept of a saved state, got None; write return, or save=None")
