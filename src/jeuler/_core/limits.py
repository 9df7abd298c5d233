"""The limits of a component's parameters, declared by its class and checked where values can be looked at."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

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
        if value is None or callable(value) or checks.is_traced(value):
            continue
        where = f"{type(component).__name__}.{name}"
        if rule == "> 0":
            checks.above_zero(where, value, unit)
        elif rule == ">= 0":
            checks.not_negative(where, value, unit)
        checks.finite(where, value, infinite=name in infinite)


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
        for field in dataclasses.fields(x):
            check_parameters(f"{name}.{field.name}", getattr(x, field.name))
    elif isinstance(x, (tuple, list)):
        for k, part in enumerate(x):
            check_parameters(f"{name}[{k}]", part)
    elif isinstance(x, dict):
        for key, part in x.items():
            check_parameters(f"{name}[{key!r}]", part)
    elif isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.inexact) and not checks.is_traced(x):
        checks.finite(name, x, infinite=True)
