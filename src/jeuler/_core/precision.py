"""Running part of the work in a given precision, whatever the precision of the program around it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PyTree = Any


def precision(dtype: Any) -> AbstractContextManager:
    """A context whose default floating dtype is ``dtype``, float32 or float64."""
    return jax.enable_x64(np.dtype(dtype) == np.float64)


def setting(name: str) -> Any:
    """The value of a setting of JAX, such as "jax_enable_x64"; the type of ``jax.config`` does not name them."""
    return getattr(jax.config, name)


def double_precision() -> AbstractContextManager:
    """A context in which float64 exists; float32 arrays keep their dtype in it."""
    return precision(np.float64)


def cast(x: PyTree, dtype: Any) -> PyTree:
    """x with its floating leaves as arrays of a real dtype, its complex ones in the same precision; beside float32
    integers have 32 bits, as everywhere where float64 is off, but where one needs more."""

    def leaf(v: Any) -> Any:
        kind = jnp.result_type(v)
        if jnp.issubdtype(kind, jnp.integer) and np.dtype(dtype) == np.float32 and np.dtype(kind).itemsize == 8:
            short = np.asarray(v).astype(np.int32 if jnp.issubdtype(kind, jnp.signedinteger) else np.uint32)
            return short if np.array_equal(short, v) else v
        if not jnp.issubdtype(kind, jnp.inexact):
            return v
        to_complex = jnp.issubdtype(kind, jnp.complexfloating)
        return jnp.asarray(np.asarray(v), dtype=np.result_type(dtype, np.complex64) if to_complex else dtype)

    return jax.tree.map(leaf, x)


def flat(y: PyTree) -> np.ndarray:
    """Every number in y as one float64 vector on the host, real parts of a leaf first."""
    return flat_rows(jax.tree.map(lambda leaf: np.asarray(leaf)[None], y))[0]


def flat_rows(y: PyTree) -> np.ndarray:
    """The same for each entry of a leading axis: (saved, number)."""
    leaves = [np.asarray(leaf).reshape(np.shape(leaf)[0], -1) for leaf in jax.tree.leaves(y)]
    parts = [part for v in leaves for part in ((v.real, v.imag) if np.iscomplexobj(v) else (v,))]
    return np.concatenate([part.astype(np.float64) for part in parts], axis=1)
