"""The one decorator that makes a class a component: a frozen dataclass that is a pytree."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jeuler._core import checks
from jeuler._core.arguments import constructor_says_what_to_write
from jeuler._core.describe import object_table, summary
from jeuler._core.partition import Rest, is_parameter, partition

T = TypeVar("T")

_PARAMETERS: dict[type, dict[str, bool]] = {}  # of each class of components: name, whether positive


@dataclass_transform(frozen_default=True)
def component(
    static: tuple[str, ...] = (), *, parameters: tuple[str, ...] | None = None, positive: tuple[str, ...] = ()
) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass that is also a pytree.

    Fields named in ``static`` are part of the structure (hashable, fixed while tracing), all others are
    children. Unflattening does not call ``__init__``, so a ``__post_init__`` sees what the user passed and never a
    transformation's placeholder. What a fit may vary are the ``parameters``, None: all that are not static; those that
    are ``positive`` are never below 0. `parameters_of` reads these two.
    """

    def decorate(cls: type[T]) -> type[T]:
        cls = dataclasses.dataclass(frozen=True, eq=False, repr=False)(_shown(cls))
        constructor_says_what_to_write(cls)
        names = tuple(field.name for field in dataclasses.fields(cls))  # type: ignore[arg-type]  # made one above
        children = tuple(name for name in names if name not in static)
        order = (*children, *static)
        keys = tuple(jax.tree_util.GetAttrKey(name) for name in children)

        values_of, static_of = _getter(children), _getter(static)

        def flatten(x: T):
            return values_of(x), static_of(x)

        def flatten_with_keys(x: T):
            values, aux = flatten(x)
            return tuple(zip(keys, values, strict=True)), aux

        def unflatten(aux: Any, values: Any) -> T:
            x = object.__new__(cls)
            vars(x).update(zip(order, (*values, *aux), strict=True))
            return x

        jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
        _PARAMETERS[cls] = {name: name in positive for name in (children if parameters is None else parameters)}
        return cls

    return decorate


def _getter(names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    """A function that takes the tuple of these attributes; flattening is most of what a short run costs."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    return lambda x: tuple([getattr(x, name) for name in names])


@dataclass_transform(frozen_default=True)
def result(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass that holds what a function found, and shows it on one screen."""
    return dataclasses.dataclass(frozen=True, repr=False)(_shown(cls))


def _shown(cls: type[T]) -> type[T]:
    """The class with a ``repr`` of names and shapes and a table for notebooks, unless it has its own."""
    for name, method in (("__repr__", summary), ("_repr_html_", object_table)):
        if getattr(cls, name, None) in (None, getattr(object, name, None)):
            setattr(cls, name, method)
    return cls


def as_float(x: ArrayLike | None) -> Array | None:
    """A parameter as a floating array; Python numbers stay weakly typed, so they follow the state's dtype.

    TypeError or ValueError for what is not made of real numbers: booleans and complex numbers are none.
    """
    if x is None or (isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)):
        return x
    if isinstance(x, (int, float)) and not isinstance(x, bool):
        return jax.device_put(float(x))  # asarray would compile a program
    if any(isinstance(part, jax.Array) for part in jax.tree.leaves(x)):  # a list with traced numbers: not for NumPy
        x = jnp.asarray(x)
    kind = x.dtype if isinstance(x, jax.Array) else np.asarray(x).dtype
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer) or kind == np.dtype(object)):
        raise TypeError(f"{kind} is not real")
    x = jnp.asarray(x) if isinstance(x, jax.Array) or kind == np.dtype(object) else from_numpy(np.asarray(x))
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


def from_numpy(x: np.ndarray) -> Array:
    """An array of NumPy as one of JAX in its own dtype, or what JAX makes of it.

    NumPy converts it: to convert it itself, or where no dtype is named, JAX compiles a program for each new shape.
    """
    dtype = jax.dtypes.canonicalize_dtype(x.dtype)
    with np.errstate(over="ignore"):
        return jnp.asarray(x.astype(dtype, copy=False), dtype)


def store_as_float(component: Any, *names: str) -> None:
    """For ``__post_init__``: replace the named fields by floating arrays. None stays where it is the default."""
    required = {field.name for field in dataclasses.fields(component) if field.default is not None}
    for name in names:
        value = getattr(component, name)
        try:
            if value is None and name in required:
                raise TypeError
            value = as_float(value)
        except (TypeError, ValueError):
            where = f"{type(component).__name__}.{name}"
            came = checks.shown(value)
            raise ValueError(f"{where} must be a number, or an array or list of real numbers, got {came}") from None
        object.__setattr__(component, name, value)


def parameters_of(part: Any) -> dict[str, bool]:
    """The fields of a component that a fit may vary, by name, with whether each is positive by its meaning.

    Only fields that hold numbers now: not an air, a collider or a function of time, and not None.
    A dataclass of the user's own that does not say which has all its fields that hold floating numbers.
    """
    part = part.whole() if isinstance(part, Partitioned) else part
    kind = type(part)
    if kind in _PARAMETERS:
        named = _PARAMETERS[kind]
    else:
        named = {field.name: False for field in dataclasses.fields(part)} if dataclasses.is_dataclass(part) else {}
    return {name: positive for name, positive in named.items() if _is_number(getattr(part, name))}


def _is_number(x: Any) -> bool:
    return isinstance(x, float) or jnp.issubdtype(getattr(x, "dtype", bool), jnp.floating)


@component(static=("function",))
class Function:
    """A plain function, or an object that can be called, where a pytree is expected: all of it is static.

    It has the attributes of what it was made of, the hooks of a component among them.
    """

    function: Any

    def __call__(self, *args: Any, **fields: Any) -> Any:
        return self.function(*args, **fields)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "function" not in self.__dict__:  # copy and pickle ask before there is anything
            raise AttributeError(name)
        return getattr(self.function, name)


@component(static=("rest",))
class Partitioned:
    """A callable pytree that holds more than floating arrays, such as a neural network: only these are its leaves.

    It has the attributes of what it was made of.
    """

    arrays: list[Any]
    rest: Rest

    def whole(self) -> Any:
        """What it was made of, with the arrays of now."""
        return self.rest.join(self.arrays)

    def __call__(self, *args: Any, **fields: Any) -> Any:
        return self.whole()(*args, **fields)

    def __repr__(self) -> str:
        return summary(self.whole())

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "rest" not in self.__dict__:  # copy and pickle ask before there is anything
            raise AttributeError(name)
        return getattr(self.whole(), name)


def replace(component: T, **changes: Any) -> T:
    """The component with some fields changed; ``dataclasses.replace``, as type checkers understand it."""
    if isinstance(component, Partitioned):
        return as_component(dataclasses.replace(component.whole(), **changes))
    return dataclasses.replace(component, **changes)  # type: ignore[type-var]  # components are


def as_component(x: Any) -> Any:
    """x as a pytree of floating arrays: as it is, or wrapped where it is a function or holds other leaves."""
    leaves = jax.tree.leaves(x)
    if not callable(x) or all(map(is_parameter, leaves)):
        return x
    is_leaf = len(leaves) == 1 and leaves[0] is x
    return Function(x) if is_leaf else Partitioned(*partition(x, is_parameter))


def unwrapped(x: Any) -> Any:
    """What the user passed in place of a component."""
    return x.function if isinstance(x, Function) else x.whole() if isinstance(x, Partitioned) else x
