"""What an object is, in words that another process finds as well: to know again what a file was written for.

Functions are known by their code and by the values that it can reach, as in `captured`; arrays by their numbers; what
cannot be looked into by its class alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._jax.captured import Opaque, is_named, parts_of


def fingerprint(x: Any) -> str:
    """A digest of an object: equal for equal ones, in this process and in others of the same version of Python."""
    return _digest(_described(x, {}))


def _digest(x: Any) -> str:
    return hashlib.sha256(repr(x).encode()).hexdigest()


def _described(x: Any, seen: dict[int, tuple[int, Any]]) -> Any:
    """Nested tuples of words; ``seen``: the number of what was met, by id, with it, so that the id stays its own."""
    if isinstance(x, (jax.Array, np.ndarray, np.generic)):
        return _of_array(x)
    if isinstance(x, (type, types.ModuleType, types.BuiltinFunctionType)) or is_named(x):
        return _named(x)
    if id(x) in seen:
        return "again", seen[id(x)][0]
    seen[id(x)] = len(seen), x
    if isinstance(x, types.CodeType):
        return _of_code(x, seen)
    if isinstance(x, (set, frozenset)):
        return "set", tuple(sorted(repr(_described(inner, {})) for inner in x))
    if dataclasses.is_dataclass(x):
        inner = [(field.name, _described(getattr(x, field.name), seen)) for field in dataclasses.fields(x)]
        return _named(type(x)), tuple(inner)
    try:
        parts = parts_of(x)
    except Opaque:
        return _named(type(x)), _of_function(x, seen) if isinstance(x, types.FunctionType) else ()
    return _of_name(parts.name, seen), tuple(_described(inner, seen) for inner in parts.inner)


def _named(x: Any) -> str:
    return f"{getattr(x, '__module__', '')}.{getattr(x, '__qualname__', getattr(x, '__name__', type(x).__qualname__))}"


def _of_name(name: Any, seen: dict[int, tuple[int, Any]]) -> Any:
    """What identifies an object among its type: code, classes, values of Python, or the object itself."""
    if isinstance(name, tuple):
        return tuple(_of_name(part, seen) for part in name)
    if isinstance(name, (type, types.CodeType)):
        return _described(name, seen)
    return repr(name) if type(name).__repr__ is not object.__repr__ else _named(getattr(name, "x", name))


def _of_array(x: Any) -> Any:
    x = jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    values = np.asarray(x)
    if values.dtype.hasobject:
        return "array", values.shape
    return "array", str(values.dtype), values.shape, hashlib.sha256(values.tobytes()).hexdigest()


def _of_code(code: types.CodeType, seen: dict[int, tuple[int, Any]]) -> Any:
    constants = tuple(_described(constant, seen) for constant in code.co_consts)
    return code.co_name, code.co_code.hex(), code.co_names, code.co_freevars, constants


def _of_function(f: types.FunctionType, seen: dict[int, tuple[int, Any]]) -> Any:
    """A function of which not all can be reached: its code, and what it encloses."""
    cells = []
    for cell in f.__closure__ or ():
        try:
            cells.append(_described(cell.cell_contents, seen))
        except ValueError:  # empty
            cells.append("empty")
    defaults = _described((f.__defaults__, f.__kwdefaults__), seen)
    return _of_code(f.__code__, seen), tuple(cells), defaults
