"""Choice by a condition, in as few equations as it has."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax


def where(condition: Any, x: Any, y: Any) -> Array:
    """``jnp.where``, which is a function of its own for each kind of operand, with conversions and broadcasts within: a
    third of all equations of a program of contact, to be traced, differentiated and compiled."""
    shape = np.broadcast_shapes(*map(np.shape, (condition, x, y)))
    whole = next((v for v in (x, y) if isinstance(v, Array) and v.shape == shape), None)
    if whole is None:
        return jnp.where(condition, x, y)
    dtype = jnp.result_type(x, y)
    chosen = condition if np.ndim(condition) == 0 else _filled(condition, whole, bool)
    return lax.select(chosen, _filled(x, whole, dtype), _filled(y, whole, dtype))


def _filled(x: Any, whole: Array, dtype: Any) -> Array:
    """x in the shape of the whole, and placed on devices as that is."""
    if not isinstance(x, Array):
        return lax.full_like(whole, x, dtype) if np.ndim(x) == 0 else jnp.broadcast_to(x, whole.shape).astype(dtype)
    x = lax.convert_element_type(x, dtype)
    return x if x.shape == whole.shape else lax.broadcast_in_dim(x, whole.shape, range(whole.ndim - x.ndim, whole.ndim))
