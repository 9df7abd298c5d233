"""Primitives and jaxprs, as jax.extend.core has them: importing that module takes 30 ms, as it imports Pallas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax

Jaxpr = Any
Primitive: Any = type(lax.add_p)


def evaluate(jaxpr: Jaxpr, operands: Sequence[Any]) -> list[Any]:
    """The results of a closed jaxpr."""
    return jax.core.eval_jaxpr(jaxpr.jaxpr, jaxpr.consts, *operands)


def is_variable(v: Any) -> bool:
    """Whether an operand of an equation is a variable, not a literal."""
    return not hasattr(v, "val")
