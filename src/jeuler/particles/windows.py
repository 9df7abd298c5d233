"""A large pool at the price of what is alive: steps on the first slots only, in a few static sizes.

An `Emitter` fills the first free slots, so the living crowd at the front of the pool and nothing has to be moved:

    slots  |alive . alive alive . . | . . . . . . . . . . . . . . . . . . |
           0                     window                             capacity
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jeuler.particles.fields import name_of

PyTree = Any
Run = Callable[[PyTree], PyTree]


SMALLEST, RATIO, MOST = 1024, 2**0.5, 12  # of the windows that are chosen for the user


def ladder(capacity: int) -> tuple[int, ...]:
    """Sizes from the capacity down, each smaller by the same ratio; every size is compiled, so there are few.

    capacity / RATIO^k,   k = 1 .. MOST, not below SMALLEST
    """
    sizes = (int(capacity / RATIO**k) for k in range(MOST, 0, -1))
    return tuple(size for size in sizes if size >= SMALLEST)


def in_windows(sizes: tuple[int, ...] | str, scene: Any, state: Any, steps: int) -> Callable[[Run, PyTree], PyTree]:
    """A function ``within(run, carry)``: ``steps`` steps of the run on the smallest window that is large enough."""
    if not sizes:
        return lambda run, carry: run(carry)
    capacity = len(state.position)
    sizes = ladder(capacity) if sizes == "auto" else sizes
    sizes = (*checked_sizes(sizes, capacity, scene, state), capacity)
    births = steps * sum(effect.max_births for effect in scene.effects if hasattr(effect, "max_births"))

    def within(run: Run, carry: PyTree) -> PyTree:
        _, _, ((_, state), _) = carry
        occupied = jnp.max(jnp.where(state.alive, jnp.arange(1, capacity + 1), 0))
        needed = jnp.minimum(occupied + births, capacity)
        smallest = sum(needed > size for size in sizes[:-1])
        return lax.switch(smallest, [on_first(size, capacity, run) for size in sizes], carry)

    return within


def on_first(size: int, capacity: int, run: Run) -> Run:
    """The run on the first ``size`` slots; the others stay as they are."""

    def is_per_slot(x):
        return x.shape[:1] == (capacity,)

    def narrow(carry: PyTree) -> PyTree:
        part = run(jax.tree.map(lambda x: x[:size] if is_per_slot(x) else x, carry))
        return jax.tree.map(lambda x, y: x.at[:size].set(y) if is_per_slot(x) else y, carry, part)

    return run if size == capacity else narrow


def checked_sizes(sizes: tuple[int, ...] | str, capacity: int, scene: Any, state: Any) -> tuple[int, ...]:
    """The sizes, if they increase and every force and effect can work on a part of the slots; or one ValueError."""
    if isinstance(sizes, str):
        raise ValueError(f'windows must be "auto" or sizes in increasing order, got {sizes!r}')
    if not isinstance(sizes, (tuple, list)):
        raise ValueError(f'windows must be "auto" or a tuple of sizes, got {sizes!r}; write windows=({sizes!r},)')
    sizes = tuple(sizes)
    if any(not isinstance(size, int) or size < 1 for size in sizes) or list(sizes) != sorted(set(sizes)):
        raise ValueError(f"windows must be positive integers in increasing order, got {sizes}")
    if state.alive is None:
        raise ValueError(
            "windows need a pool with births or deaths, got a scene in which every particle is always alive"
        )
    for effect in scene.effects:
        if getattr(effect, "max_births", 0) is None:
            raise ValueError(
                f"windows need the most births in a step, got {name_of(effect)}.max_births = None; "
                f"pass max_births=..., at least rate * dt"
            )
    sizes = tuple(size for size in sizes if size < capacity)
    for part in (*scene.forces, *scene.effects):
        try:
            if sizes and hasattr(part, "check"):
                part.check(sizes[0], state.position.shape[1])
        except ValueError as error:
            raise ValueError(
                f"windows need forces and effects that take any number of particles; {name_of(part)} does not: {error}"
            ) from None
    return sizes
