"""Arithmetic on pytrees, and the one decorator that makes a component a frozen pytree."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

PyTree = Any
Parameter = Any  # of a component: a number, list or array as passed, a floating array as kept
T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def component(static: tuple[str, ...] = ()) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass that is also a pytree.

    Fields named in ``static`` are part of the structure (hashable, fixed while tracing), all others are
    children. Unflattening does not call ``__init__``, so a ``__post_init__`` sees what a person passed and never a
    transformation's placeholder.
    """

    def decorate(cls: type[T]) -> type[T]:
        cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
        names = tuple(field.name for field in dataclasses.fields(cls))  # type: ignore[arg-type]  # made one above
        children = tuple(name for name in names if name not in static)
        keys = tuple(jax.tree_util.GetAttrKey(name) for name in children)

        def flatten(x: T):
            return tuple(getattr(x, n) for n in children), tuple(getattr(x, n) for n in static)

        def flatten_with_keys(x: T):
            values, aux = flatten(x)
            return tuple(zip(keys, values, strict=True)), aux

        def unflatten(aux: Any, values: Any) -> T:
            x = object.__new__(cls)
            for name, value in zip((*children, *static), (*values, *aux), strict=True):
                object.__setattr__(x, name, value)
            return x

        jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
        return cls

    return decorate


def as_float(x: ArrayLike | None) -> Array | None:
    """A parameter as a floating array; Python numbers stay weakly typed, so they follow the state's dtype."""
    if x is None or (isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.inexact)):
        return x
    if isinstance(x, (bool, int, float)):
        return jnp.asarray(float(x))
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


def store_as_float(component: Any, *names: str) -> None:
    """For ``__post_init__``: replace the named fields by floating arrays. None stays where it is the default."""
    required = {field.name for field in dataclasses.fields(component) if field.default is dataclasses.MISSING}
    for name in names:
        value = getattr(component, name)
        try:
            if value is None and name in required:
                raise TypeError
            value = as_float(value)
        except (TypeError, ValueError):
            where = f"{type(component).__name__}.{name}"
            raise ValueError(f"{where} must be a number, or an array or list of numbers, got {value!r}") from None
        object.__setattr__(component, name, value)


@component(static=("function",))
class Function:
    """A plain function in a place where a pytree is expected: all of it is static."""

    function: Callable

    def __call__(self, *args: Any, **fields: Any) -> Any:
        return self.function(*args, **fields)


def replace(component: T, **changes: Any) -> T:
    """The component with some fields changed; ``dataclasses.replace``, as type checkers understand it."""
    return dataclasses.replace(component, **changes)  # type: ignore[type-var]  # components are


def as_component(x: Any) -> Any:
    """x if it is a pytree of arrays already; a plain function is wrapped, so that no leaf is a function."""
    return Function(x) if callable(x) and jax.tree_util.all_leaves([x]) else x


def real_dtype(dtype: Any) -> Any:
    """The dtype of the real part: float32 for complex64."""
    return jnp.finfo(dtype).dtype


def time_dtype(y: PyTree) -> Any:
    """The dtype of t and dt for a state: its widest real dtype, float32 at least."""
    leaves = [real_dtype(leaf.dtype) for leaf in jax.tree.leaves(y)]
    return jnp.result_type(jnp.float32, *leaves) if leaves else jnp.result_type(float)


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
    """Whether every number in y is finite, a boolean scalar."""
    finite = jnp.asarray(True)
    for leaf in jax.tree.leaves(y):
        finite &= jnp.all(jnp.isfinite(leaf))
    return finite


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
