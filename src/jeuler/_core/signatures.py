"""The arguments of functions, kept: to ask `inspect` at every call of a run takes 20 us."""

from __future__ import annotations

import functools
import inspect
import types
import weakref
from typing import Any

_KEPT: weakref.WeakKeyDictionary[types.FunctionType, dict[bool, inspect.Signature]] = weakref.WeakKeyDictionary()


def signature_of(f: Any) -> inspect.Signature | None:
    """The signature of f; None where Python does not know it, as of some built-in functions."""
    try:
        function = _underneath(f)
        if function is None:
            return inspect.signature(f)
        return _kept(function, function is not f)
    except (TypeError, ValueError):
        return None


def _underneath(f: Any) -> types.FunctionType | None:
    """The function, of a method or of the class of an object, whose signature f has; None where something else has."""
    if isinstance(f, types.FunctionType):
        return f
    if isinstance(f, types.MethodType):
        return f.__func__ if isinstance(f.__func__, types.FunctionType) else None
    if isinstance(f, (type, functools.partial)) or hasattr(f, "__signature__") or hasattr(f, "__wrapped__"):
        return None
    calls = [vars(kind)["__call__"] for kind in type(f).__mro__ if "__call__" in vars(kind)]
    return calls[0] if calls and isinstance(calls[0], types.FunctionType) else None


def _kept(function: types.FunctionType, bound: bool) -> inspect.Signature:
    """The signature of a function, or of a method that it is."""
    if not (function.__defaults__ or function.__kwdefaults__ or function.__annotations__ or vars(function)):
        return _of_code(function.__code__, bound)
    found = _KEPT.setdefault(function, {})
    if bound not in found:
        found[bound] = _asked(function, bound)
    return found[bound]


@functools.lru_cache(maxsize=256)
def _of_code(code: types.CodeType, bound: bool) -> inspect.Signature:
    """Of functions made again and again from the same code, such as a lambda within a loop."""
    cells = tuple(types.CellType() for _ in code.co_freevars)
    return _asked(types.FunctionType(code, {}, closure=cells), bound)


def _asked(function: types.FunctionType, bound: bool) -> inspect.Signature:
    return inspect.signature(types.MethodType(function, 0) if bound else function)
