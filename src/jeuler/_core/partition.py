"""A pytree in two parts: its arrays, which are traced, and the rest, which is a fixed part of the program.

A neural network is such a pytree: weights beside activation functions, names and sizes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PyTree = Any


class _ArrayHere:
    """Stands in `Rest.others` where an array is."""

    def __repr__(self) -> str:
        return "array"

    def __reduce__(self) -> str:
        return "ARRAY_HERE"  # unpickled, it is this one again


ARRAY_HERE = _ArrayHere()


@dataclasses.dataclass(frozen=True)
class Rest:
    """A pytree without its arrays: the structure, and the other leaves in their places. Hashable."""

    structure: Any
    others: tuple[Any, ...]

    def join(self, arrays: list[Any] | tuple[Any, ...]) -> PyTree:
        """The pytree with these arrays in it."""
        given = iter(arrays)
        leaves = [next(given) if other is ARRAY_HERE else _value(other) for other in self.others]
        return jax.tree.unflatten(self.structure, leaves)

    def __reduce__(self) -> tuple[Any, ...]:
        """To be pickled as the tree itself: JAX cannot pickle the structure of classes that are not its own."""
        marked = jax.tree.unflatten(self.structure, [_value(other) for other in self.others])
        return _rest_of_marked, (marked,)


@dataclasses.dataclass(frozen=True, eq=False)
class Fixed:
    """A leaf without a hash, as a part of the program: a NumPy array equal by its content, all else by identity."""

    value: Any

    def __eq__(self, other: Any) -> bool:
        if not isinstance(other, Fixed):
            return NotImplemented
        a, b = self.value, other.value
        if not (_has_form(a) and _has_form(b)):
            return a is b
        return a is b or (a.dtype == b.dtype and np.array_equal(np.asarray(a), np.asarray(b)))

    def __hash__(self) -> int:
        return hash((str(self.value.dtype), self.value.shape)) if _has_form(self.value) else id(self.value)


def _has_form(x: Any) -> bool:
    return hasattr(x, "dtype") and hasattr(x, "shape")


def _value(other: Any) -> Any:
    return other.value if isinstance(other, Fixed) else other


def is_array(x: Any) -> bool:
    """Whether a leaf is traced: an array of numbers, or a Python float or complex; an int or a bool is a setting."""
    if isinstance(x, (jax.Array, float, complex)) or hasattr(x, "__jax_array__"):
        return True
    return _has_form(x) and (isinstance(x, jax.ShapeDtypeStruct) or np.dtype(x.dtype).kind in "biufc" or _is_small(x))


def _is_small(x: Any) -> bool:
    """Whether the dtype is one of those that NumPy does not know by itself, such as bfloat16."""
    return jnp.issubdtype(x.dtype, np.inexact) or jnp.issubdtype(x.dtype, np.integer)


def is_parameter(x: Any) -> bool:
    """Whether a leaf may be differentiated, or cannot be looked at: a floating or complex number, or a traced one."""
    if isinstance(x, (float, complex, jax.core.Tracer)):
        return True
    return _has_form(x) and (jnp.issubdtype(x.dtype, np.inexact) or jnp.issubdtype(x.dtype, jax.dtypes.extended))


def _rest_of_marked(tree: PyTree) -> Rest:
    return partition(tree, lambda leaf: leaf is ARRAY_HERE)[1]


def partition(tree: PyTree, is_dynamic: Callable[[Any], bool] = is_array) -> tuple[list[Any], Rest]:
    """The leaves of a pytree that are arrays, in order, and the rest, which puts such arrays back."""
    leaves, structure = jax.tree.flatten(tree)
    dynamic = [is_dynamic(x) for x in leaves]
    others = (ARRAY_HERE if d else _hashable(x) for x, d in zip(leaves, dynamic, strict=True))
    return [x for x, d in zip(leaves, dynamic, strict=True) if d], Rest(structure, tuple(others))


def _hashable(x: Any) -> Any:
    try:
        hash(x)
    except TypeError:
        return Fixed(x)
    return Fixed(x) if _has_form(x) else x  # jax arrays have no hash, NumPy's scalars compare across dtypes


def arrays_only(
    function: Callable[..., Any], tree: PyTree, is_dynamic: Callable[[Any], bool] = is_array
) -> tuple[Callable[..., Any], PyTree]:
    """A function whose last argument is this pytree, and the pytree, so that all leaves of it are arrays.

    Where they are so already, both come back as they are.
    """
    arrays, rest = partition(tree, is_dynamic)
    if all(other is ARRAY_HERE for other in rest.others):
        return function, tree
    return OfArrays(function, rest), arrays


@dataclasses.dataclass(frozen=True)
class OfArrays:
    """A function of (..., pytree) as one of (..., the arrays in that pytree)."""

    function: Callable[..., Any]
    rest: Rest

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments[:-1], self.rest.join(arguments[-1]))
