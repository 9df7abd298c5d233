"""Arithmetic on pytrees."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from jeuler._core.precision import setting

PyTree = Any


def real_dtype(dtype: Any) -> Any:
    """The dtype of the real part: float32 for complex64."""
    return jnp.finfo(dtype).dtype


def time_dtype(y: PyTree) -> Any:
    """The dtype of t and dt for a state: its widest real dtype, float32 at least."""
    leaves = jax.tree.leaves(y)
    dtypes = frozenset([leaf.dtype for leaf in leaves])
    return _widest(dtypes, setting("jax_enable_x64")) if leaves else jnp.result_type(float)


@functools.lru_cache(maxsize=64)
def _widest(dtypes: frozenset[Any], x64: bool) -> Any:
    return jnp.result_type(jnp.float32, *map(real_dtype, dtypes))


def add(x: PyTree, y: PyTree) -> PyTree:
    """x + y, leaf by leaf."""
    return jax.tree.map(lambda a, b: a + b, x, y)


def subtract(x: PyTree, y: PyTree) -> PyTree:
    """x - y, leaf by leaf."""
    return jax.tree.map(lambda a, b: a - b, x, y)


def scale(a: ArrayLike, x: PyTree) -> PyTree:
    """a x, leaf by leaf, for a real scalar a taken to each leaf's precision."""

    def leaf(v):
        v = jnp.asarray(v)
        if not jnp.issubdtype(v.dtype, jnp.inexact):  # an integer slope, such as jnp.zeros(n, int)
            return jnp.asarray(a) * v
        return jnp.asarray(a).astype(real_dtype(v.dtype)) * v

    return jax.tree.map(leaf, x)


def combine(weights: tuple[float, ...], trees: list[PyTree]) -> PyTree:
    """sum_i w_i x_i over pytrees; terms whose weight is zero are never computed."""
    terms = [scale(w, x) if w != 1.0 else x for w, x in zip(weights, trees, strict=True) if w != 0.0]
    total = terms[0]
    for term in terms[1:]:
        total = add(total, term)
    return total


def in_dtypes_of(y: PyTree, x: PyTree) -> PyTree:
    """x with each leaf in the dtype of that of y."""
    return jax.tree.map(lambda a, b: jnp.asarray(a).astype(b.dtype), x, y)


def all_finite(y: PyTree) -> Array:
    """Whether every number in y is finite, a boolean scalar.

    By one sum of floats for all leaves of a shape, placed alike: an "and" of booleans takes XLA on CPU more kernels,
    and up to six times as long to compile.
    """
    of_a_kind: dict[Any, Any] = {}
    for leaf in jax.tree.leaves(y):
        finite = jnp.isfinite(leaf)
        kind = jax.typeof(finite)
        of_a_kind[kind] = finite & of_a_kind.get(kind, True)
    counts = [jnp.sum(jnp.where(finite, jnp.float32(0), 1)) for finite in of_a_kind.values()]
    return sum(counts, jnp.float32(0)) == 0


def largest(y: PyTree) -> Array:
    """The largest absolute value in y; 0 where there is none."""
    nothing: Any = 0
    return functools.reduce(jnp.maximum, [jnp.max(jnp.abs(leaf), initial=0) for leaf in jax.tree.leaves(y)], nothing)


def parts(y: PyTree) -> tuple[list[PyTree], Any]:
    """The outermost parts of a pytree, and the structure that puts such parts together."""
    return jax.tree.flatten(y, is_leaf=lambda part: part is not y)


def real_vector(y: PyTree) -> tuple[Array, Callable[[Array], PyTree]]:
    """y as one real vector, and the way back; a complex leaf is its real and its imaginary part."""
    leaves, structure = jax.tree.flatten(y)
    is_complex = [jnp.iscomplexobj(leaf) for leaf in leaves]
    parts = [(leaf.real, leaf.imag) if c else leaf for leaf, c in zip(leaves, is_complex, strict=True)]
    vector, unravel = ravel_pytree(parts)

    def back(vector: Array) -> PyTree:
        parts = unravel(vector)
        whole = [jax.lax.complex(*part) if c else part for part, c in zip(parts, is_complex, strict=True)]
        return jax.tree.unflatten(structure, whole)

    return vector, back
