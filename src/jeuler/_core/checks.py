"""Checks of what the user passed: one clear ValueError each, at call time, before anything is traced.

Values that are being traced cannot be looked at, so value checks pass over them; types and shapes are always seen.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.signatures import signature_of


def is_traced(x: Any) -> bool:
    return isinstance(x, jax.core.Tracer)


def shown(x: Any, most: int = 60) -> str:
    """What came, on one line of at most so many characters."""
    if isinstance(x, (np.ndarray, jax.Array)) and (x.ndim or is_traced(x)):
        return f"{'a traced ' if is_traced(x) else 'an array of '}{x.dtype} of shape {x.shape}"
    if isinstance(x, type):
        return f"the class {x.__name__}"
    if dataclasses.is_dataclass(x) or (not callable(x) and "\n" in repr(x)):
        return f"{type(x).__name__}(...)"
    text = " ".join(getattr(x, "__name__", repr(x)).split())
    return text if len(text) <= most else f"{text[: most - 3]}..."


def number(name: str, x: Any) -> None:
    """x is a finite real scalar."""
    if type(x) is float and math.isfinite(x):
        return
    expected = f"{name} must be one finite real number"
    if is_traced(x):
        if x.ndim or not jnp.issubdtype(x.dtype, jnp.floating):
            raise ValueError(f"{expected}, got a traced {x.dtype} of shape {x.shape}")
        return
    try:
        given = np.asarray(x)
        if given.dtype.kind not in "iufO" and not jnp.issubdtype(given.dtype, jnp.floating):
            raise TypeError
        array = given.astype(float)
    except (TypeError, ValueError):
        raise ValueError(f"{expected}, got {shown(x)}") from None
    if array.ndim:
        raise ValueError(f"{expected}, got {shown(x)}; for a batch use jax.vmap")
    if not math.isfinite(array):
        raise ValueError(f"{expected}, got {x!r}")


def reals(name: str, x: Any, meaning: str, dtype: Any = float) -> Any:
    """x as an array of real numbers; traced ones as they are."""
    if is_traced(x):
        return x
    try:
        array = np.asarray(x)
        if array.dtype.kind not in "iufO" and not jnp.issubdtype(array.dtype, jnp.floating):
            raise TypeError
        if array.dtype == object and any(isinstance(each, (str, bytes, bool)) for each in array.flat):
            raise TypeError
        return array.astype(dtype)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be {meaning}, got {shown(x)}") from None


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


def integers(name: str, came: Any, meaning: str) -> np.ndarray:
    """``came`` as an integer array of indices from 0 to 2^31 - 1; nothing is rounded or wrapped."""
    expected = f"{name} must be {meaning}"
    if any(map(is_traced, jax.tree.leaves(came))):
        raise ValueError(
            f"{expected}, fixed while tracing, got traced ones; pass a NumPy array, not an argument of jit"
        )
    try:
        array = np.asarray(came)
    except (TypeError, ValueError):
        raise ValueError(f"{expected}, got {shown(came)}; its rows differ in length") from None
    if not array.size and array.dtype != object:
        return array.astype(np.int32)
    if not np.issubdtype(array.dtype, np.integer):
        whole = np.issubdtype(array.dtype, np.floating) and np.array_equal(array, np.round(array))
        hint = f"; convert them, np.asarray({name.rpartition('.')[2]}, dtype=int)" if whole else ""
        raise ValueError(f"{expected}, got {array.dtype} {shown(came)}{hint}")
    wrong = np.argwhere((array < 0) | (array > np.iinfo(np.int32).max))
    if wrong.size:
        first = wrong[0][0] if len(wrong[0]) else ...
        raise ValueError(f"{expected} from 0, got {name.rpartition('.')[2]}[{first}] = {array[first].tolist()}")
    return array.astype(np.int32)


def different(name: str, came: np.ndarray, kind: str) -> None:
    """No row of these indices holds the same one twice."""
    rows = np.sort(np.atleast_2d(came), axis=1)
    wrong = np.flatnonzero((rows[:, 1:] == rows[:, :-1]).any(axis=1))
    if wrong.size:
        row = np.atleast_2d(came)[wrong[0]].tolist()
        where = (
            f"{name}[{wrong[0]}] = {row}" if came.ndim > 1 else f"{rows[0][1:][rows[0, 1:] == rows[0, :-1]][0]} twice"
        )
        raise ValueError(f"{name} must be different {kind}, got {where}; name each once")


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


def _places(mask: Any) -> Any:
    """The indices at which a mask is set; quick where there is none, for these checks are made at every call."""
    return np.argwhere(mask) if mask.any() else ()


def not_negative(name: str, x: Any, unit: str) -> None:
    """No number in the array x is below zero. A traced x is passed over, as is NaN, which `diagnose` finds."""
    if is_traced(x):
        return
    below = _places(np.asarray(x) < 0)
    if len(below):
        where = f" at index {', '.join(map(str, below[0]))}" if np.ndim(x) else ""
        raise ValueError(
            f"{name} must not be negative, got {_at(x, below[0])}{unit and ' ' + unit}{where}; "
            f"where gradient steps made it so, keep it at 0 or above, as `fit` does by bounds"
        )


def above_zero(name: str, x: Any, unit: str) -> None:
    """Every number in the array x is above zero. A traced x is passed over, as is NaN."""
    if is_traced(x):
        return
    below = _places(np.asarray(x) <= 0)
    if len(below):
        where = f" at index {', '.join(map(str, below[0]))}" if np.ndim(x) else ""
        raise ValueError(f"{name} must be greater than 0{unit and ' ' + unit}, got {_at(x, below[0])}{where}")


def finite(name: str, x: Any, *, infinite: bool = False) -> None:
    """No number in the array x is NaN, nor inf unless that has a meaning. A traced x is passed over."""
    if is_traced(x):
        return
    values = np.asarray(x)
    values = values.astype(np.float32) if values.dtype.kind not in "fc" else values
    wrong = _places(np.isnan(values) if infinite else ~np.isfinite(values))
    if len(wrong):
        where = f" at index {', '.join(map(str, wrong[0]))}" if np.ndim(x) else ""
        expected = "a number" if infinite else "finite"
        raise ValueError(
            f"{name} must be {expected}, got {_at(x, wrong[0])}{where}; `diagnose` finds where a run made it"
        )


def _at(x: Any, index: Any) -> str:
    return f"{float(np.asarray(x)[tuple(index)].real):g}"


def points_somewhere(name: str, x: Any) -> None:
    """The vector x has a direction. A traced x is passed over."""
    if not is_traced(x) and not np.any(np.asarray(x)):
        raise ValueError(
            f"{name} must point somewhere, got {shown(np.asarray(x).tolist())}; any length above 0 will do"
        )


def fit_together(name: str, **arrays: Any) -> None:
    """Arrays whose shapes broadcast to one."""
    shapes = [np.shape(x) for x in arrays.values()]
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        which = " and ".join(arrays)
        raise ValueError(
            f"{name}: {which} must be numbers or of one shape, got {' and '.join(map(str, shapes))}"
        ) from None


def in_order(low_name: str, low: Any, high_name: str, high: Any) -> None:
    """No number in low is above its partner in high. Traced ones are passed over."""
    if not is_traced(low) and not is_traced(high) and np.any(np.asarray(low) > np.asarray(high)):
        low, high = (shown(np.asarray(x).tolist()) for x in (low, high))
        raise ValueError(f"{low_name} must not be above {high_name}, got {low} and {high}; swap the two")


def true_or_false(name: str, x: Any) -> None:
    """x is True or False."""
    if not isinstance(x, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(x)}")


def count(name: str, x: Any, *, least: int = 0) -> int:
    """x as a Python int of at least ``least``: it fixes the shape of the program, so it cannot be traced."""
    try:
        if isinstance(x, (bool, np.bool_)):
            raise TypeError
        n = operator.index(x)
    except (TypeError, jax.errors.TracerIntegerConversionError):
        hint = f"pass int({name})"
        if is_traced(x):
            hint = "mark it static (static_argnames) under jit"
        elif not isinstance(x, (float, np.floating)):
            hint = "write it as a number, such as 100"
        raise ValueError(f"{name} must be a Python integer, got {shown(x)}; {hint}") from None
    if n < least:
        raise ValueError(f"{name} must be at least {least}, got {n}")
    return n


def refuse_class(expected: str, x: Any) -> None:
    """x is an object, not its class; ``expected`` begins the message."""
    if isinstance(x, type):
        raise ValueError(f"{expected}, got the class {x.__name__}; make one, {x.__name__}(...)")


def kind(name: str, x: Any, expected: type) -> None:
    """x is one of the expected class."""
    if not isinstance(x, expected):
        raise ValueError(f"{name} must be a {expected.__name__}, got {shown(x)}; make one, {expected.__name__}(...)")


def function(name: str, f: Any, form: str, hint: str) -> None:
    """f can be called with the arguments of the form, such as "(t, y, args) -> dy/dt"."""
    if not callable(f):
        raise ValueError(f"{name} must be a function {form}, got {shown(f)}; {hint}")
    signature = signature_of(f)
    try:
        if signature:
            signature.bind(*form.split("->")[0].split(","))
    except TypeError:
        raise ValueError(f"{name} must be a function {form}, got {shown(f)}{signature}; {hint}") from None


def random_key(key: Any) -> None:
    """key is None or one key of ``jax.random``, of the new kind or an array of unsigned integers."""
    if key is None:
        return
    dtype = getattr(key, "dtype", None)
    new = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not new and dtype != jnp.uint32:
        raise ValueError(f"key must be a jax.random.key, got {shown(key)}; pass key=jax.random.key(0)")
    if key.ndim != (0 if new else 1):
        raise ValueError(f"key must be one jax.random.key, got keys of shape {key.shape}; for a batch use jax.vmap")


def path_name(path: tuple[Any, ...]) -> str:
    """The path of a leaf in a pytree, written for people."""
    return jax.tree_util.keystr(path) or "y"


def state(name: str, y: Any) -> Any:
    """y as a pytree of strongly typed floating or complex arrays."""

    if not jax.tree.leaves(y):
        raise ValueError(f"{name} must hold an array of numbers, got {shown(y)}; a state without numbers has no motion")

    def leaf(path, x):
        try:
            dtype = jnp.result_type(x)
        except (TypeError, ValueError):
            raise ValueError(f"{name}{jax.tree_util.keystr(path)} must be an array, got {shown(x)}") from None
        if not jnp.issubdtype(dtype, jnp.inexact):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must be floating, got {dtype}; "
                f"convert it, for example jnp.asarray(x, dtype=float)"
            )
        return jax.lax.convert_element_type(x, jax.dtypes.canonicalize_dtype(dtype))

    return jax.tree_util.tree_map_with_path(leaf, y)


def form_of(what: str, function: Any, *arguments: Any) -> Any:
    """Shapes and dtypes of what the user's function returns; one ValueError where it cannot be traced."""
    try:
        return jax.eval_shape(function, *arguments)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        numpy = isinstance(error, jax.errors.TracerArrayConversionError)
        hint = "it hands a traced value to NumPy; write jnp in place of np"
        if not numpy:
            hint = "it takes a Python decision, such as `if`, on a traced value; write jnp.where(condition, a, b)"
        raise ValueError(f"{what} must be traceable, but {hint}") from error
    except TypeError as error:
        if "is not a valid JAX type" not in str(error):
            raise
        raise ValueError(f"{what} must return arrays of numbers; look at what it returns") from error


def _as_array(expected: Any, came: Any) -> str:
    single = jax.tree.structure(0)
    return ", jnp.stack([...]) in place of a list" if expected == single and came.num_leaves > 1 else ""


def field_form(f: Any) -> None:
    """f is a function that can be called as a vector field, ``f(t, y, args) -> dy/dt``."""
    hint = "args is there even if f does not need it"
    if hasattr(type(f), "vector_field"):
        hint = "pass scene.vector_field, or run the scene by jeuler.simulate"
    refuse_class("f must be a function (t, y, args) -> dy/dt", f)
    function("f", f, "(t, y, args) -> dy/dt", hint)


def vector_field(f: Any, t: Any, y: Any, args: Any) -> None:
    """f is a vector field that returns the form of y."""
    field_form(f)
    same_form("the vector field f", y, form_of("the vector field f", f, t, y, args))


def same_form(what: str, y: Any, dy: Any) -> None:
    """dy (shapes and dtypes are enough) has the structure and shapes of y and does not widen its dtypes."""
    expected: Any = jax.tree.structure(y)
    came: Any = jax.tree.structure(dy)
    if expected != came:
        raise ValueError(
            f"{what} must return the structure of the state, {expected}, got {came}; "
            f"return one value for each part of it{_as_array(expected, came)}"
        )
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
