"""Compiled programs, kept for the next call: without ``jax.jit`` around it, a run compiles once, not at every call.

What a call needs is one function of all its inputs. Arrays and numbers among these are inputs of the program; functions
are compared by what they are and can reach (`captured`), so that a closure made again finds the program of the one
before. Where they cannot be compared, the function is traced again, which is always right, and only the compiled
program is kept, by its text.

Under ``jax.jit`` nothing of this happens. Under ``grad`` or ``vmap`` alone the program is differentiated or batched as
a jitted function is.
"""

from __future__ import annotations

import collections
import functools
import hashlib
import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax._src import core  # which trace is at work: no public name says it without warnings

from jeuler._core.component import Function, Partitioned
from jeuler._jax.captured import CYCLE, Opaque, WithArrays, token, trusted

MOST = 128  # programs kept; the one not used for the longest goes first
NUMBERS = frozenset([float, int, bool, complex])
NEEDS_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


class Kept:
    """The last so many values, by their keys."""

    def __init__(self, most: int) -> None:
        self.most, self.lock = most, threading.Lock()
        self.values: collections.OrderedDict[Any, Any] = collections.OrderedDict()

    def get(self, key: Any) -> Any:
        with self.lock:
            value = self.values.get(key)
            if value is not None:
                self.values.move_to_end(key)
            return value

    def put(self, key: Any, value: Any) -> Any:
        with self.lock:
            value = self.values.setdefault(key, value)
            while len(self.values) > self.most:
                self.values.popitem(last=False)
            return value


by_structure, by_text = Kept(MOST), Kept(MOST)
current = threading.local()  # the leaves of the call that is being traced


def call(function: Callable, inputs: tuple, settings: tuple = ()) -> Any:
    """function(*inputs, *settings) by a program kept from an earlier call where there is one.

    Args:
      function: a function of a module, which returns a pytree of arrays.
      inputs: pytrees of arrays and numbers; functions and other callables, each wrapped in ``Function``, may depend on
        anything. The function gets these wrapped as well.
      settings: hashable values that are part of the program.
    """
    if jax.config.jax_disable_jit or _under_jit():  # type: ignore[attr-defined]
        return function(*inputs, *settings)
    classes: set[type] = set()
    leaves, structure = jax.tree.flatten(inputs, is_leaf=functools.partial(_stands_alone, classes))
    try:
        dynamic, arrays, tokens = _tokens(leaves)
        own = tuple([token(kind, None, {}) for kind in sorted(classes, key=id)])
        key = function, settings, structure, tokens, own
        program = by_structure.get(key)
    except (Opaque, TypeError):  # a TypeError: something that has no hash
        return _traced_again(function, settings, leaves, structure)
    if program is None:
        program = by_structure.put(key, Program(function, settings, structure, tokens))
    if program.needs_values:
        return _traced_again(function, settings, leaves, structure)
    try:
        return program(leaves, dynamic, arrays)
    except (ValueError, *NEEDS_VALUES) as error:
        if not _needs_values(error):
            raise
        # an array of a closure is used as a number while tracing, as in float(x)
        program.needs_values = True
        return _traced_again(function, settings, leaves, structure)


class Program:
    """A function compiled for one structure of its inputs; ``jax.jit`` keeps it for each shape, dtype and device."""

    def __init__(self, function: Callable, settings: tuple, structure: Any, tokens: tuple) -> None:
        self.needs_values = False

        def run(dynamic, arrays):
            given, made = iter(dynamic), WithArrays(arrays)
            pairs = zip(current.leaves, tokens, strict=True)
            leaves = [next(given) if name is None else made.of(leaf) for leaf, name in pairs]
            return function(*jax.tree.unflatten(structure, leaves), *settings)

        self.compiled = jax.jit(run)

    def __call__(self, leaves: list, dynamic: list, arrays: list) -> Any:
        before, current.leaves = getattr(current, "leaves", None), leaves
        try:
            return self.compiled(dynamic, arrays)
        finally:
            current.leaves = before


def _traced_again(function: Callable, settings: tuple, leaves: list, structure: Any) -> Any:
    """The function traced for this call alone; what was compiled of the same text before is used again."""
    is_dynamic = [_is_dynamic(leaf) for leaf in leaves]
    dynamic = [leaf for leaf, d in zip(leaves, is_dynamic, strict=True) if d]

    def run(dynamic):
        given = iter(dynamic)
        merged = [next(given) if d else leaf for leaf, d in zip(leaves, is_dynamic, strict=True)]
        return function(*jax.tree.unflatten(structure, merged), *settings)

    if _is_transformed():
        return run(dynamic)
    try:
        lowered = jax.jit(run).lower(dynamic)
    except (ValueError, *NEEDS_VALUES) as error:
        if not _needs_values(error):
            raise
        return run(dynamic)
    key = hashlib.sha256(lowered.as_text().encode()).digest(), lowered.in_tree, lowered.out_tree, _devices(dynamic)
    compiled = by_text.get(key) or by_text.put(key, lowered.compile())
    return compiled(dynamic)


def _needs_values(error: BaseException | None) -> bool:
    """Whether this error, or what it was raised from, is that something traced was asked for its value."""
    return error is not None and (isinstance(error, NEEDS_VALUES) or _needs_values(error.__cause__))


def _tokens(leaves: list) -> tuple[list, list, tuple]:
    """The inputs of the program, the arrays within functions, and the names of the leaves, None for an input."""
    dynamic: list = []
    arrays: list = []
    names: list[tuple | None] = []
    seen: dict[int, tuple] = {}
    for leaf in leaves:
        if _is_dynamic(leaf):
            dynamic.append(leaf)
            names.append(None)
        else:
            names.append((token(leaf, arrays, seen),))
    if CYCLE in map(_or_array, arrays) and len(arrays) > 1:
        raise Opaque("arrays in functions that call themselves")
    return dynamic, [x for x in arrays if x is not CYCLE], tuple(names)


def _or_array(x: Any) -> Any:
    return x if x is CYCLE else None  # arrays are not to be compared


def _is_dynamic(leaf: Any) -> bool:
    if type(leaf) in NUMBERS or isinstance(leaf, jax.Array):
        return True
    return isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype.kind not in "OSUMm"


def _stands_alone(classes: set[type], x: Any) -> bool:
    """Whether a node of the inputs is compared as a whole; other classes of the person's own are noted."""
    kind = type(x)
    if kind is Function or kind is Partitioned:
        return True
    if trusted(kind.__module__):
        return False
    classes.add(kind)
    return callable(x)


def _devices(dynamic: list) -> tuple:
    return tuple([getattr(x, "sharding", None) for x in dynamic])


def _is_transformed() -> bool:
    """Whether a derivative, a batch or a program is being worked out around this call."""
    return not core.trace_state_clean()


def _under_jit() -> bool:
    """Whether a program is being traced around this call."""
    return _is_transformed() and core.unsafe_am_i_under_a_jit()
