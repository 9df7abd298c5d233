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
from jax._src.array import ArrayImpl

from jeuler._core.component import Function, Partitioned
from jeuler._core.precision import setting
from jeuler._jax.apart import apart
from jeuler._jax.captured import CYCLE, Opaque, WithArrays, is_named, token, trusted
from jeuler._jax.haste import Haste, jit_in_haste
from jeuler._jax.placed import is_placed, may_be_placed

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
by_whole = Kept(MOST)  # the same programs, by the structure of inputs in which nothing has to be looked into
current = threading.local()  # the inputs of the call that is being traced


def call(function: Callable, inputs: tuple, settings: tuple = (), haste: Haste = "none") -> Any:
    """function(*inputs, *settings) by a program kept from an earlier call where there is one.

    Args:
      function: a function of a module, which returns a pytree of arrays.
      inputs: pytrees of arrays and numbers; functions and other callables, each wrapped in ``Function``, may depend on
        anything. The function gets these wrapped as well.
      settings: hashable values that are part of the program.
      haste: with how little work of XLA's optimiser it is compiled, where no derivative or batch is asked for.
    """
    if setting("jax_disable_jit") or _under_jit():
        return _on_a_mesh(function, inputs, settings)
    return prepared(function, inputs, settings, haste)()


def prepared(function: Callable, inputs: tuple, settings: tuple = (), haste: Haste = "none") -> Call:
    """`call`, for several calls of the same inputs: ``prepared(...)(*further)`` passes further pytrees of arrays.

    What comes back takes the memory of the first of these, which cannot be used again.
    """
    plain, whole = jax.tree.flatten(inputs)
    if all(map(_is_plain, plain)):
        try:
            program = by_whole.get((function, settings, whole))
        except TypeError:  # something that has no hash
            program = None
        if program is not None:
            return Call(function, settings, inputs, program, plain, [])
    return _compared(function, inputs, settings, whole, haste)


def _compared(function: Callable, inputs: tuple, settings: tuple, whole: Any, haste: Haste) -> Call:
    """`prepared`, of inputs whose functions have to be compared by what they can reach."""
    classes: set[type] = set()
    leaves, structure = _flattened(inputs, classes)
    try:
        dynamic, arrays, tokens = _tokens(leaves)
        own = tuple([token(kind, None, {}) for kind in sorted(classes, key=id)])
        key = function, settings, structure, tokens, own
        program = by_structure.get(key)
    except (Opaque, TypeError):  # a TypeError: something that has no hash
        return Call(function, settings, inputs)
    if program is None:
        program = by_structure.put(key, Program(function, settings, structure, tokens, haste))
    if not classes and all(map(_is_constant, leaves)):
        by_whole.put((function, settings, whole), program)
    return Call(function, settings, inputs, program, dynamic, arrays)


class Call:
    """A call with these inputs, by the program kept for their structure or, without one, traced for it alone."""

    def __init__(
        self,
        function: Callable,
        settings: tuple,
        inputs: tuple,
        program: Program | None = None,
        dynamic: list | None = None,
        arrays: list | None = None,
    ) -> None:
        self.of_call = function, settings, inputs
        self.program, self.dynamic, self.arrays = program, dynamic, arrays
        self.notes: dict[Any, Any] = {} if program is None else program.notes
        self.compiled: Callable | None = None

    def __call__(self, *further: Any) -> Any:
        if self.compiled is not None:
            return self.compiled(further)
        program = self.program
        if program is None or program.needs_values:
            self.compiled = _traced_again(*self.of_call, further)
            return self.compiled(further)
        try:
            return program(self.of_call[2], self.dynamic, self.arrays, further)
        except (ValueError, *NEEDS_VALUES) as error:
            if not needs_values(error):
                raise
            # an array of a closure is used as a number while tracing, as in float(x)
            program.needs_values = True
            return self(*further)


class Program:
    """A function compiled for one structure of its inputs; ``jax.jit`` keeps it for each shape, dtype and device."""

    def __init__(self, function: Callable, settings: tuple, structure: Any, tokens: tuple, haste: Haste) -> None:
        self.needs_values = False
        self.notes: dict[Any, Any] = {}  # what its callers keep with it

        def run(dynamic, arrays, first, rest):
            leaves = _put_together(_flattened(current.inputs)[0], tokens, dynamic, arrays)
            return function(*jax.tree.unflatten(structure, leaves), *settings, *first, *rest)

        run = apart(run)
        self.compiled = jax.jit(run, donate_argnums=2)
        self.in_haste = self.compiled if haste == "none" else jit_in_haste(run, haste, donate_argnums=2)

    def __call__(self, inputs: tuple, dynamic: list | None, arrays: list | None, further: tuple) -> Any:
        before, current.inputs = getattr(current, "inputs", None), inputs
        try:
            compiled = self.compiled if is_transformed() else self.in_haste  # options are for whole programs
            return compiled(dynamic, arrays, further[:1], further[1:])
        finally:
            current.inputs = before


def _on_a_mesh(function: Callable, inputs: tuple, settings: tuple) -> Any:
    """function(*inputs, *settings) while a program is traced, where arrays may be on a mesh of explicit axes."""
    leaves, structure = _flattened(inputs)
    placed = any(is_placed(leaf) for leaf in leaves if isinstance(leaf, jax.Array))
    try:
        dynamic, arrays, tokens = _tokens(leaves) if placed or may_be_placed() else ((), (), None)
    except (Opaque, TypeError):  # what its functions read cannot be told
        tokens = None
    if tokens is None:
        return function(*inputs, *settings)

    def run(dynamic, arrays):
        return function(*jax.tree.unflatten(structure, _put_together(leaves, tokens, dynamic, arrays)), *settings)

    return apart(run)(dynamic, arrays)


def _put_together(leaves: list, tokens: tuple, dynamic: Any, arrays: Any) -> list:
    """The leaves of a call, with these inputs and these arrays within functions."""
    given, made = iter(dynamic), WithArrays(arrays)
    return [next(given) if name is None else made.of(leaf) for leaf, name in zip(leaves, tokens, strict=True)]


def _traced_again(function: Callable, settings: tuple, inputs: tuple, further: tuple) -> Callable:
    """The function of what is ``further``, traced for this call alone; what was compiled of the same text is used."""
    leaves, structure = _flattened(inputs)
    is_dynamic = [_is_dynamic(leaf) for leaf in leaves]
    dynamic = [leaf for leaf, d in zip(leaves, is_dynamic, strict=True) if d]

    def run(dynamic, first, rest):
        given = iter(dynamic)
        merged = [next(given) if d else leaf for leaf, d in zip(leaves, is_dynamic, strict=True)]
        return function(*jax.tree.unflatten(structure, merged), *settings, *first, *rest)

    def as_it_is(further):
        return run(dynamic, further[:1], further[1:])

    if is_transformed():
        return as_it_is
    try:
        lowered = jax.jit(run, donate_argnums=1).lower(dynamic, further[:1], further[1:])
    except (ValueError, *NEEDS_VALUES) as error:
        if not needs_values(error) or further:
            raise
        return as_it_is
    key = hashlib.sha256(lowered.as_text().encode()).digest(), lowered.in_tree, lowered.out_tree, _devices(dynamic)
    compiled = by_text.get(key) or by_text.put(key, lowered.compile())
    return lambda further: compiled(dynamic, further[:1], further[1:])


def lowered(function: Callable, inputs: tuple, settings: tuple, *further: Any) -> tuple[Any, list]:
    """``function(*inputs, *settings, *further)`` before it is compiled, and those inputs that are arrays.

    ``.compile()(arrays, further[:1], further[1:])`` runs it, in the memory of the first of ``further``.
    """
    leaves, structure = jax.tree.flatten(inputs, is_leaf=functools.partial(_stands_alone, set()))
    is_dynamic = [_is_dynamic(leaf) for leaf in leaves]

    def run(dynamic, first, rest):
        given = iter(dynamic)
        merged = [next(given) if d else leaf for leaf, d in zip(leaves, is_dynamic, strict=True)]
        return function(*jax.tree.unflatten(structure, merged), *settings, *first, *rest)

    dynamic = [leaf for leaf, d in zip(leaves, is_dynamic, strict=True) if d]
    return jax.jit(run, donate_argnums=1).lower(dynamic, further[:1], further[1:]), dynamic


def needs_values(error: BaseException | None) -> bool:
    """Whether this error, or what it was raised from, is that something traced was asked for its value."""
    return error is not None and (isinstance(error, NEEDS_VALUES) or needs_values(error.__cause__))


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


def _is_plain(leaf: Any) -> bool:
    """Whether a leaf is surely an input of the program, and traced by nothing around."""
    kind = type(leaf)
    return kind is ArrayImpl or kind in NUMBERS or (kind is np.ndarray and leaf.dtype.kind in "fciub")


def _is_constant(leaf: Any) -> bool:
    """Whether an input, or a function that is the same whenever it is the same object."""
    if type(leaf) is not Function:
        return _is_dynamic(leaf)
    f = leaf.function
    return f is None or is_named(f)


def _flattened(inputs: tuple, classes: set[type] | None = None) -> tuple[list, Any]:
    """The leaves of the inputs and their structure; functions and the like are leaves."""
    return jax.tree.flatten(inputs, is_leaf=functools.partial(_stands_alone, set() if classes is None else classes))


def _stands_alone(classes: set[type], x: Any) -> bool:
    """Whether a node of the inputs is compared as a whole; other classes of the user's own are noted."""
    kind = type(x)
    if kind is Function or kind is Partitioned:
        return True
    if trusted(kind.__module__):
        return False
    classes.add(kind)
    return callable(x)


def _devices(dynamic: list) -> tuple:
    return tuple([getattr(x, "sharding", None) for x in dynamic])


def is_transformed() -> bool:
    """Whether a derivative, a batch or a program is being computed around this call."""
    return not core.trace_state_clean()


def _under_jit() -> bool:
    """Whether a program is being traced around this call."""
    return is_transformed() and core.unsafe_am_i_under_a_jit()
