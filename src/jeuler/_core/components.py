"""Arrays (particle, dim) as one array a component, the layout of the hot loop.

A loop over (particle, 3) does not vectorise and its gathers go row by row; a loop over three arrays (particle,) does.
So what runs at each step is written component by component. `split` and `stack` undo each other: where one follows the
other the compiler drops both, forward and backward (each is the other's transpose), and what is written for arrays
(particle, dim), a user's own force for example, still fits in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import Array, lax


def split(x: Array) -> tuple[Array, ...]:
    """(particle, dim) to dim arrays (particle,)."""
    return tuple(part[:, 0] for part in lax.split(x, (1,) * x.shape[1], axis=1)) if x.shape[1] else ()


def stack(parts: Sequence[Array]) -> Array:
    """dim arrays (particle,) to (particle, dim)."""
    return jnp.stack(parts, axis=1)


def by_component(function: Callable[..., Array], *arrays: Array) -> Array:
    """``function`` applied to each component of arrays (particle, dim) in turn."""
    return stack([function(*parts) for parts in zip(*map(split, arrays), strict=True)])


def per_particle(x: Array) -> Array:
    """A parameter of shape () or (particle,), ready to multiply (particle, dim)."""
    return x[:, None] if x.ndim else x


def mass_that_feels(mass: Array) -> Array:
    """The mass, and 0 for a pinned particle (mass = inf), so that no inf reaches the sum of forces."""
    return jnp.where(jnp.isfinite(mass), mass, 0)
