"""Uniform random numbers by the name of a row: many rows at the price of one call.

A number is a function of a key and of its place (row, column) alone, so a row does not change when others come or go.
``jax.random`` would need a key for each row, and on a CPU a key costs as much as a row.

Source: J. Salmon, M. Moraes, R. Dror, D. Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011 (Threefry-2x32).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax


def uniform_rows(key: Array, rows: list[int], count: int, dtype: Any) -> Array:
    """Uniform numbers in [0, 1), (row, count), float32 or float64; ``rows`` are numbers that name them, below 2^32."""
    row, column = np.asarray(rows, np.uint32)[:, None], jnp.arange(count, dtype=jnp.uint32)
    if str(jax.random.key_impl(key)) != "threefry2x32":
        keys = [jax.random.fold_in(key, row) for row in rows]
        return jnp.stack([jax.random.uniform(key, (count,), dtype) for key in keys])
    from jax.extend.random import threefry_2x32  # here, as it takes 30 ms to import and few scenes have births

    places = jnp.stack(jnp.broadcast_arrays(row, column))
    high, low = threefry_2x32(jax.random.key_data(key), places.ravel()).reshape(places.shape)
    kind = jnp.finfo(dtype)
    bits = high if kind.bits == 32 else (high.astype(jnp.uint64) << 32) | low.astype(jnp.uint64)
    # the leading bits become the fraction of a number in [1, 2)
    one = np.ones((), dtype).view(bits.dtype)
    return lax.bitcast_convert_type(bits >> (kind.bits - kind.nmant) | one, kind.dtype) - 1
