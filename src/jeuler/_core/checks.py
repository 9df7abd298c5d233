"""Checks of what a person passed: one clear ValueError each, at call time, before anything is traced.

Values that are being traced cannot be looked at, so value checks pass over them; types and shapes are always seen.
"""

from __future__ import annotations

import inspect
import math
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_traced(x: Any) -> bool:
    return isinstance(x, jax.core.Tracer)


def number(name: str, x: Any) -> None:
    """x is a finite real scalar."""
    expected = f"{name} must be one finite real number"
    if is_traced(x):
        if x.ndim or not jnp.issubdtype(x.dtype, jnp.floating):
            raise ValueError(f"{expected}, got a traced {x.dtype} of shape {x.shape}")
        return
    try:
        array = np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{expected}, got {x!r}") from None
    if array.ndim or isinstance(x, (bool, np.bool_, str)):
        raise ValueError(f"{expected}, got {x!r}; for a batch use jax.vmap")
    if not math.isfinite(array):
        raise ValueError(f"{expected}, got {x!r}")


def positive(name: str, x: Any, unit: str = "") -> None:
    """x is a finite real scalar above zero."""
    number(name, x)
    if not is_traced(x) and not float(x) > 0:
        raise ValueError(f"{name} must be greater than 0{unit and ' ' + unit}, got {x!r}")


def interval(t0: Any, t1: Any) -> tuple[float, float]:
    """t0 and t1 as floats, t1 the later one."""
    for name, t in (("t0", t0), ("t1", t1)):
        number(name, t)
    if not float(t1) > float(t0):
        raise ValueError(f"t1 must be later than t0={float(t0):g}, got {float(t1):g}")
    return float(t0), float(t1)


def untraced(function: str, *inputs: Any) -> None:
    """No array in the inputs of this function is being traced."""
    if any(map(is_traced, jax.tree.leaves(inputs))):
        raise ValueError(f"{function} must be called with values, got traced ones; call it outside jit, grad, vmap")


def shape(name: str, came: tuple[int, ...], *expected: tuple[int, ...], meaning: str = "") -> None:
    """The shape that came is one of those expected."""
    if came not in expected:
        what = f"{' or '.join(map(str, expected))}{meaning and ', ' + meaning}"
        raise ValueError(f"{name} must have shape {what}, got {came}")


def indices(name: str, came: Any, count: int, kind: str = "indices") -> None:
    """Each of the indices is that of one of ``count`` things."""
    came = np.asarray(came)
    if came.size and not 0 <= came.min() <= came.max() < count:
        raise ValueError(f"{name} must be {kind} from 0 to {count - 1}, got from {came.min()} to {came.max()}")


def increasing(name: str, times: Any) -> None:
    """Each of the times is later than the one before. Traced times are passed over."""
    if is_traced(times):
        return
    wrong = np.flatnonzero(~(np.diff(np.asarray(times)) > 0))
    if wrong.size:
        k = wrong[0]
        raise ValueError(
            f"{name} must increase, got {times[k]:g} then {times[k + 1]:g} at {k + 1}; "
            f"sort them and drop what is repeated"
        )


def not_negative(name: str, x: Any, unit: str) -> None:
    """No number in the array x is below zero. A traced x is passed over, as is NaN, which `diagnose` finds."""
    if is_traced(x):
        return
    below = np.argwhere(np.asarray(x) < 0)
    if len(below):
        where = f" at index {', '.join(map(str, below[0]))}" if np.ndim(x) else ""
        raise ValueError(
            f"{name} must not be negative, got {float(np.asarray(x)[tuple(below[0])]):g} {unit}{where}; "
            f"where gradient steps made it so, take them on its logarithm and pass jnp.exp of that, as `fit` does"
        )


def count(name: str, x: Any, *, least: int = 0) -> int:
    """x as a Python int of at least ``least``: it fixes the shape of the program, so it cannot be traced."""
    try:
        if isinstance(x, (bool, np.bool_)):
            raise TypeError
        n = operator.index(x)
    except (TypeError, jax.errors.TracerIntegerConversionError):
        hint = "mark it static (static_argnames) under jit" if is_traced(x) else f"pass int({name})"
        raise ValueError(f"{name} must be a Python integer, got {x!r}; {hint}") from None
    if n < least:
        raise ValueError(f"{name} must be at least {least}, got {n}")
    return n


def refuse_class(expected: str, x: Any) -> None:
    """x is a thing, not the class of such things; ``expected`` begins the message."""
    if isinstance(x, type):
        raise ValueError(f"{expected}, got the class {x.__name__}; make one, {x.__name__}(...)")


def kind(name: str, x: Any, expected: type) -> None:
    """x is one of the expected class."""
    if not isinstance(x, expected):
        raise ValueError(f"{name} must be a {expected.__name__}, got {x!r}")


def function(name: str, f: Any, form: str, hint: str) -> None:
    """f can be called with the arguments of the form, such as "(t, y, args) -> dy/dt"."""
    if not callable(f):
        raise ValueError(f"{name} must be a function {form}, got {f!r}; {hint}")
    signature = signature_of(f)
    try:
        if signature:
            signature.bind(*form.split("->")[0].split(","))
    except TypeError:
        raise ValueError(
            f"{name} must be a function {form}, got {getattr(f, '__name__', repr(f))}{signature}; {hint}"
        ) from None


def signature_of(f: Any) -> inspect.Signature | None:
    """The arguments of f; None for what does not say, such as some functions built into Python."""
    try:
        return inspect.signature(f)
    except (TypeError, ValueError):
        return None


def random_key(key: Any) -> None:
    """key is None or a key of ``jax.random``, of the new kind or an array of unsigned integers."""
    dtype = getattr(key, "dtype", None)
    if key is None or (dtype is not None and (jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == jnp.uint32)):
        return
    raise ValueError(f"key must be a jax.random.key, got {key!r}; pass key=jax.random.key(0)")


def path_name(path: tuple) -> str:
    """A leaf's place in a pytree, to be read by a person."""
    return jax.tree_util.keystr(path) or "y"


def state(name: str, y: Any) -> Any:
    """y as a pytree of strongly typed floating or complex arrays."""

    def leaf(path, x):
        try:
            dtype = jnp.result_type(x)
        except (TypeError, ValueError):
            raise ValueError(f"{name}{jax.tree_util.keystr(path)} must be an array, got {x!r}") from None
        if not jnp.issubdtype(dtype, jnp.inexact):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must be floating, got {dtype}; "
                f"convert it, for example jnp.asarray(x, dtype=float)"
            )
        return jax.lax.convert_element_type(x, jax.dtypes.canonicalize_dtype(dtype))

    return jax.tree_util.tree_map_with_path(leaf, y)


def same_form(what: str, y: Any, dy: Any) -> None:
    """dy (shapes and dtypes are enough) has the structure and shapes of y and does not widen its dtypes."""
    expected: Any = jax.tree.structure(y)
    came: Any = jax.tree.structure(dy)
    if expected != came:
        raise ValueError(f"{what} must return the structure of the state, {expected}, got {came}")
    came_leaves = jax.tree.leaves(dy)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(y), came_leaves, strict=True):
        where = path_name(path)
        if jnp.shape(a) != jnp.shape(b):
            raise ValueError(f"{what} must keep the shape of {where}, {jnp.shape(a)}, got {jnp.shape(b)}")
        if jnp.result_type(a, b) != a.dtype:
            raise ValueError(
                f"{what} must keep the dtype of {where}, {a.dtype}, got {b.dtype}; "
                f"cast what it returns, or the state, so that the two agree"
            )
