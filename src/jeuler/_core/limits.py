"""The limits of a component's parameters, declared by its class and checked where values can be looked at."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks

Limits = dict[str, tuple[str, str]]  # of each parameter: ">= 0", "> 0" or "", and its unit


def check_limits(component: Any) -> None:
    """One ValueError if a parameter is out of the limits that its class declares.

    ``limits = {"ks": (">= 0", "N/m"), "core": ("> 0", "m"), ...}``: each number is so, and finite unless the name is
    among the class's ``may_be_infinite``. What is traced, None or a function cannot be looked at.
    """
    infinite = getattr(type(component), "may_be_infinite", ())
    for name, (rule, unit) in getattr(type(component), "limits", {}).items():
        value = getattr(component, name)
        if value is None or checks.is_traced(value) or callable(value):
            continue
        if _is_within(value, rule, name in infinite):
            continue
        where = f"{type(component).__name__}.{name}"
        if rule == "> 0":
            checks.above_zero(where, value, unit)
        elif rule == ">= 0":
            checks.not_negative(where, value, unit)
        checks.finite(where, value, infinite=name in infinite)


def _is_within(value: Any, rule: str, infinite: bool) -> bool:
    """Whether floating numbers are surely right: from the least and the largest of them, NaN where there is one."""
    value = np.asarray(value)
    if value.dtype.kind != "f" or not value.size:
        return False
    least, largest = (value.item(), value.item()) if not value.ndim else (value.min(), value.max())
    above = least > 0 if rule == "> 0" else least >= 0 if rule else infinite or least > -math.inf
    return bool(above and (least == least if infinite else largest < math.inf))


def check_axes(component: Any) -> None:
    """One ValueError if a parameter has more axes than its class declares, ``axes = {"velocity": 1, "period": 0}``.

    For use in a run, where an array for each member of a batch has lost the axis of the batch.
    """
    for name, most in getattr(type(component), "axes", {}).items():
        value = getattr(component, name)
        if not callable(value) and jnp.ndim(value) > most:
            expected = "have shape (dim,)" if most else "be one number"
            raise ValueError(
                f"{type(component).__name__}.{name} must {expected}, got shape {jnp.shape(value)}; "
                f"for a batch of scenes use jax.vmap"
            )


def check_parameters(name: str, x: Any) -> None:
    """One ValueError if a number anywhere in a tree of components is NaN, or out of the limits of its class."""
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        check_limits(x)
        check_axes(x)
        limits = getattr(type(x), "limits", {})
        for field in _fields(type(x)):
            value = getattr(x, field)
            if value is not None and not (field in limits and isinstance(value, jax.Array)):
                check_parameters(f"{name}.{field}", value)
    elif isinstance(x, (tuple, list)):
        for k, part in enumerate(x):
            check_parameters(f"{name}[{k}]", part)
    elif isinstance(x, dict):
        for key, part in x.items():
            check_parameters(f"{name}[{key!r}]", part)
    elif _is_inexact(x) and not _is_within(x, "", infinite=True):
        checks.finite(name, x, infinite=True)


def _is_inexact(x: Any) -> bool:
    """Whether an array of floating or complex numbers that can be looked at."""
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.inexact) and not checks.is_traced(x)


@functools.lru_cache(maxsize=256)
def _fields(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))
