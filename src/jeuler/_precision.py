"""Running a part of the work in float64, whatever the precision of the program around it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def double_precision() -> AbstractContextManager:
    """A context in which float64 exists; float32 arrays keep their dtype in it."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    from jax.experimental import enable_x64  # its place before jax 0.8

    return enable_x64(True)


def cast(x: Any, dtype: Any) -> Any:
    """The floating leaves of x as arrays of a real dtype, or the complex one of the same precision."""

    def leaf(v: Any) -> Any:
        if not jnp.issubdtype(jnp.result_type(v), jnp.inexact):
            return v
        complex_leaf = jnp.issubdtype(jnp.result_type(v), jnp.complexfloating)
        return jnp.asarray(np.asarray(v), dtype=np.result_type(dtype, np.complex64) if complex_leaf else dtype)

    return jax.tree.map(leaf, x)
