"""What a function depends on, found without calling it: its code, and the values that the code can reach.

A program compiled for one function serves another with the same code and equal values. Values that are looked at here:
closures, defaults, globals that the code names, attributes of methods' objects, containers within these. JAX arrays
among them become inputs of the program; all others are compared. What cannot be compared is `Opaque`.
"""

from __future__ import annotations

import dataclasses
import dis
import enum
import functools
import sys
import types
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jeuler._core.component import Function, Partitioned, as_component
from jeuler._core.indices import Indices
from jeuler._core.partition import ARRAY_HERE, Fixed, OfArrays, Rest

PyTreeDef = type(jax.tree.structure(0))
MOST_BYTES = 2**20  # of a NumPy array that is compared by its content
UNSEEN = frozenset(["eval", "exec", "getattr", "globals", "input", "locals", "open", "setattr", "vars", "__dict__"])
LIBRARIES = frozenset([
    "diffrax", "equinox", "jax", "jaxlib", "jaxtyping", "jeuler", "lineax", "ml_dtypes", "numpy", "optax", "optimistix",
    "scipy",
])  # fmt: skip
IMPURE = frozenset(["datetime", "io", "numpy.random", "os", "random", "secrets", "sys", "time"])  # modules
ATOMS = frozenset([bool, bytes, complex, int, range, str, type(None), type(...), type(NotImplemented)])
ARRAY = "array"


class Opaque(Exception):
    """A function depends on a value that cannot be compared between calls."""


class Parts:
    """An object taken apart: what identifies it among its type, the objects it holds, and how to rebuild it from such.

    Without ``make`` it is always the same object; arrays within it are compared by identity then.
    """

    __slots__ = ("inner", "make", "name")

    def __init__(self, name: Any, inner: Any = (), make: Callable | None = None) -> None:
        self.name, self.inner, self.make = name, inner, make


def parts_of(x: Any) -> Parts:
    """How an object is compared."""
    kind: Any = type(x)
    if kind in ATOMS:
        return Parts((kind, x))
    if kind is float:
        return Parts((kind, x.hex()))
    if kind in PARTS:
        return PARTS[kind](x)
    if isinstance(x, (np.ndarray, np.generic)):
        return _of_numpy(x)
    if isinstance(x, (np.dtype, enum.Enum, Indices, PyTreeDef)):
        return Parts((kind, x))
    if isinstance(x, type):
        return Parts(x) if trusted(x.__module__) else _of_class(x)
    if kind in HELD or (trusted(kind.__module__) and is_named(x)):
        return Parts(_Held(x))
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return Parts(kind, tuple(x), kind._make)
    if _is_plain(kind):
        names = tuple(vars(x))
        return Parts((kind, names), (kind, *vars(x).values()), lambda new: _instance(kind, names, new[1:]))
    raise Opaque(kind.__name__)


class _Held:
    """An object compared by identity."""

    def __init__(self, x: Any) -> None:
        self.x = x

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and self.x is other.x

    def __hash__(self) -> int:
        return id(self.x)


def is_named(x: Any) -> bool:
    """Whether a module that does not change has this object under its name."""
    module, name = sys.modules.get(getattr(x, "__module__", None) or ""), getattr(x, "__qualname__", None)
    return module is not None and name is not None and trusted(module.__name__) and getattr(module, name, None) is x


@functools.lru_cache(maxsize=1024)
def _is_plain(kind: Any) -> bool:
    """Whether all of an object of this class is in its ``__dict__``."""
    bases = [base for base in kind.__mro__ if base is not object]
    own_slots = any(getattr(base, "__slots__", ()) for base in bases)
    return kind.__flags__ & (1 << 9) != 0 and kind.__basicsize__ <= object.__basicsize__ + 16 and not own_slots


def _instance(kind: type, names: tuple[str, ...], values: Any) -> Any:
    x: Any = object.__new__(kind)
    for name, value in zip(names, values, strict=True):
        object.__setattr__(x, name, value)
    return x


@functools.cache
def trusted(module: str | None) -> bool:
    """Whether a module is of a library whose functions and settings stay as they are while a program runs."""
    top = (module or "").partition(".")[0]
    return top in LIBRARIES or top in sys.stdlib_module_names - {"__main__"}


# Of each kind


def _of_numpy(x: Any) -> Parts:
    if x.dtype.hasobject or x.nbytes > MOST_BYTES:
        raise Opaque(f"NumPy array of {x.nbytes} bytes")
    return Parts((type(x), x.dtype, x.shape, x.tobytes()))


def _of_function(f: types.FunctionType) -> Parts:
    if trusted(f.__module__) and is_named(f):
        return Parts(_Held(f))
    code, names = f.__code__, named_in(f.__code__)
    cells = [_contents(cell) for cell in f.__closure__ or ()]
    inner: dict[str, Any] = {
        "cells": cells,
        "defaults": f.__defaults__,
        "keywords": f.__kwdefaults__,
        "attributes": vars(f),
    }
    if not trusted(f.__module__):
        inner["globals"] = {n: f.__globals__[n] for n in names.variables if n in f.__globals__}
        inner["modules"] = _from_modules(inner["globals"].values(), names.attributes)
    return Parts(code, tuple(inner.values()), lambda new: _fill(f, *new))


def _from_modules(values: Any, attributes: tuple[str, ...]) -> Any:
    """What code finds in modules of the user's own; Opaque where a module gives other values each time."""
    found = []
    for module in values:
        if not isinstance(module, types.ModuleType):
            continue
        if module.__name__ in IMPURE or (module is np and "random" in attributes):
            raise Opaque(module.__name__)
        if not trusted(module.__name__):
            found += [vars(module)[name] for name in attributes if name in vars(module)]
    return _Fixed(found)


class _Fixed(list):
    """Values of which none can be made again."""


class _Empty:
    """A cell that has no value yet."""


def _contents(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:
        return _Empty


def _hollow(f: types.FunctionType) -> types.FunctionType:
    """A function of the same code, with cells and globals of its own, for `_fill`."""
    cells = tuple(types.CellType() for _ in f.__closure__ or ())
    return types.FunctionType(f.__code__, dict(f.__globals__), f.__name__, f.__defaults__, cells)


def _fill(
    f: Any, cells: list, defaults: Any, keywords: Any, attributes: dict, variables: Any = None, _: Any = ()
) -> Any:
    new = _hollow(f)
    new.__defaults__, new.__kwdefaults__, new.__qualname__ = defaults, keywords, f.__qualname__
    vars(new).update(attributes)
    new.__globals__.update(variables or {})
    for cell, value in zip(new.__closure__ or (), cells, strict=True):
        if value is not _Empty:
            cell.cell_contents = value
    return new


@dataclasses.dataclass(frozen=True)
class _Names:
    variables: tuple[str, ...]
    attributes: tuple[str, ...]


@functools.lru_cache(maxsize=1024)
def named_in(code: types.CodeType) -> _Names:
    """The globals and the attributes that code names; Opaque where it looks up others, or writes outside of itself."""
    variables, attributes = set(), set()
    for line in dis.get_instructions(code):
        if line.opname in ("STORE_GLOBAL", "DELETE_GLOBAL", "DELETE_DEREF"):
            raise Opaque(line.opname)
        if line.opname == "IMPORT_NAME" and (not trusted(line.argval) or line.argval in IMPURE):
            raise Opaque(f"import {line.argval}")
        if line.opname == "STORE_DEREF" and line.argval in code.co_freevars:
            raise Opaque(f"nonlocal {line.argval}")
        if line.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            variables.add(line.argval)
        elif line.argval in code.co_names:
            attributes.add(line.argval)
    if UNSEEN & (variables | attributes):
        raise Opaque(str(UNSEEN & (variables | attributes)))
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            inner = named_in(constant)
            variables.update(inner.variables)
            attributes.update(inner.attributes)
    return _Names(tuple(sorted(variables)), tuple(sorted(attributes)))


def _of_class(kind: type) -> Parts:
    """A class of the user's own: its functions may change, as in a notebook whose cell is run again."""
    if any(not trusted(type(base).__module__) for base in kind.__mro__):
        raise Opaque(f"metaclass of {kind.__name__}")
    inner = [base for base in kind.__bases__ if base is not object]
    for name, value in vars(kind).items():
        for wrapped in ("__func__", "__wrapped__", "fget", "func", "method"):
            value = getattr(value, wrapped, value)
        if isinstance(value, types.FunctionType) or (not name.startswith("__") and _is_value(value)):
            inner.append(value)
    return Parts(kind, tuple(inner))


def _is_value(x: Any) -> bool:
    return type(x) in ATOMS or isinstance(x, (float, list, tuple, dict, jax.Array, np.ndarray, np.generic))


def _of_method(m: types.MethodType) -> Parts:
    return Parts("method", (m.__func__, m.__self__), lambda new: types.MethodType(*new))


def _of_dict(d: dict) -> Parts:
    keys = tuple(d)
    if any(type(key) not in ATOMS for key in keys):
        raise Opaque("keys of a dict")
    return Parts((dict, keys), tuple(d.values()), lambda new: dict(zip(keys, new, strict=True)))


def _of_set(s: Any) -> Parts:
    if any(type(x) not in ATOMS for x in s):
        raise Opaque("set")
    return Parts((type(s), frozenset((type(x), x) for x in s)))


def _of_partial(p: functools.partial) -> Parts:
    kind = type(p)
    return Parts(kind, (p.func, p.args, p.keywords), lambda new: kind(new[0], *new[1], **new[2]))


def _of_builtin(f: Any) -> Parts:
    if isinstance(f.__self__, (types.ModuleType, type(None))):
        return Parts(_Held(f))
    raise Opaque(f"method {f.__name__} of {type(f.__self__).__name__}")


def _of_rest(rest: Rest) -> Parts:
    marks = [ARRAY] * rest.others.count(ARRAY_HERE)
    return Parts((Rest, rest.structure), (rest.join(marks),))  # the tree itself, for the sake of its classes


HELD = frozenset([np.ufunc, type(jax.jit(len))])
PARTS: dict[type, Callable[[Any], Parts]] = {
    types.FunctionType: _of_function,
    types.MethodType: _of_method,
    types.BuiltinFunctionType: _of_builtin,
    types.ModuleType: lambda m: Parts(_Held(m)),
    functools.partial: _of_partial,
    jax.tree_util.Partial: _of_partial,
    slice: lambda x: Parts(slice, (x.start, x.stop, x.step), lambda new: slice(*new)),
    _Fixed: lambda x: Parts(_Fixed, tuple(x)),
    list: lambda x: Parts(list, tuple(x), list),
    tuple: lambda x: Parts(tuple, x, tuple),
    dict: _of_dict,
    set: _of_set,
    frozenset: _of_set,
    Rest: _of_rest,
    Fixed: lambda x: Parts("fixed", (x.value,), lambda new: Fixed(*new)),
    OfArrays: lambda x: Parts("of arrays", (x.function, x.rest), lambda new: OfArrays(*new)),
    Function: lambda x: Parts("function", (x.function,), lambda new: Function(*new)),
    Partitioned: lambda x: Parts("whole", (x.whole(),), lambda new: as_component(*new)),
}


# The two walks over an object: what it is compared by, and the same with other arrays in it


def token(x: Any, arrays: list | None, seen: dict[int, tuple]) -> Any:
    """What an object is compared by, hashable; the JAX arrays within are appended to ``arrays``.

    None for arrays: they are compared by identity. ``seen``: what the walk has met, by id, and whether it is through.
    """
    if isinstance(x, jax.Array):
        if arrays is None:
            return _Held(x)
        arrays.append(x)
        return ARRAY
    parts = parts_of(x)
    if not parts.inner:
        return parts.name
    if id(x) in seen:
        number, _, done = seen[id(x)]
        if not done and arrays is not None:
            arrays.append(CYCLE)
        return "again", number
    number = len(seen)
    seen[id(x)] = number, x, False  # held, for the id of what is gone may be given again
    if parts.make:
        inner = tuple([token(part, arrays, seen) for part in parts.inner])
    else:
        own: dict[int, tuple] = {} if arrays is not None else seen
        inner = tuple([token(part, None, own) for part in parts.inner])
    seen[id(x)] = number, x, True
    return parts.name, inner


CYCLE = object()  # among the arrays: something refers to itself


class WithArrays:
    """Objects made again with other arrays in place of those that `token` found, in the same order."""

    def __init__(self, arrays: Any) -> None:
        self.arrays = iter(arrays)
        self.made: dict[int, tuple[Any, Any]] = {}

    def of(self, x: Any) -> Any:
        if isinstance(x, jax.Array):
            return next(self.arrays)
        parts = parts_of(x)
        if not parts.inner or not parts.make:
            return x
        if id(x) not in self.made:
            self.made[id(x)] = x, x  # what refers to itself holds no arrays
            new = [self.of(inner) for inner in parts.inner]
            same = all(a is b for a, b in zip(new, parts.inner, strict=True))
            self.made[id(x)] = x, x if same else parts.make(new)
        return self.made[id(x)][1]
