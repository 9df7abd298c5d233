"""Uniform random numbers by the name of a row: many rows at the price of one call.

A number is a function of a key and of its place (row, column) alone, so a row does not change when others come or go.
``jax.random`` would need a key for each row, and on a CPU a key costs as much as a row: its 20 rounds are a loop of
five turns with a dozen small kernels each.

Source: J. Salmon, M. Moraes, R. Dror, D. Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011 (Threefry-2x32).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)


def uniform_rows(key: Array, rows: list[int], count: int, dtype: Any) -> Array:
    """Uniform numbers in [0, 1), (row, count), float32 or float64; ``rows`` are numbers that name them, below 2^32."""
    row, column = np.asarray(rows, np.uint32)[:, None], jnp.arange(count, dtype=jnp.uint32)
    if str(jax.random.key_impl(key)) != "threefry2x32":
        keys = [jax.random.fold_in(key, row) for row in rows]
        return jnp.stack([jax.random.uniform(key, (count,), dtype) for key in keys])
    high, low = threefry(jax.random.key_data(key), *jnp.broadcast_arrays(row, column))
    kind = jnp.finfo(dtype)
    bits = high if kind.bits == 32 else (high.astype(jnp.uint64) << 32) | low.astype(jnp.uint64)
    # the leading bits become the fraction of a number in [1, 2)
    one = np.ones((), dtype).view(bits.dtype)
    return lax.bitcast_convert_type(bits >> (kind.bits - kind.nmant) | one, kind.dtype) - 1


def threefry(key: Array, high: Array, low: Array) -> tuple[Array, Array]:
    """The blocks (high, low), two words each, enciphered with a key of two words: 20 rounds of add, rotate and xor.

    The last sixteen are a loop of two turns. Without one the compiler would work all rounds out again in each kernel
    that uses a number; with a turn for each four it would make twice as many kernels.
    """

    def four_rounds(x, y, rotations, words, count):
        for rotation in rotations:
            x = x + y
            y = x ^ ((y << rotation) | (y >> (32 - rotation)))
        return x + words[1], y + words[2] + count.astype(jnp.uint32)

    def eight_rounds(turn, carry):
        x, y, (a, b, c) = carry
        x, y = four_rounds(x, y, _ROTATIONS[1], (b, c, a), 2 * turn + 2)
        x, y = four_rounds(x, y, _ROTATIONS[0], (c, a, b), 2 * turn + 3)
        return x, y, (c, a, b)

    words = (key[0], key[1], key[0] ^ key[1] ^ _PARITY)
    x, y = four_rounds(high + words[0], low + words[1], _ROTATIONS[0], words, np.uint32(1))
    x, y, _ = lax.fori_loop(0, 2, eight_rounds, (x, y, words))
    return x, y
