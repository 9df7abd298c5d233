"""Primitives and jaxprs, as jax.extend.core has them: importing that module takes 30 ms, as it imports Pallas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.interpreters import partial_eval

Jaxpr = Any
Primitive: Any = type(lax.add_p)
rewriting: Any = partial_eval  # its ``lower_jaxpr2`` is of JAX 0.12


def evaluate(jaxpr: Jaxpr, operands: Sequence[Any]) -> list[Any]:
    """The results of a closed jaxpr."""
    return jax.core.eval_jaxpr(jaxpr.jaxpr, jaxpr.consts, *operands)


def holding_programs(name: str) -> Primitive:
    """A primitive of several results whose parameters may be closed jaxprs.

    From JAX 0.12 on some functions are high-level equations (``jnp.searchsorted`` is one), which are rewritten
    into those of arrays before a program is compiled; also in what an equation holds, which has to say how.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True

    def to_lojax(*operands: Any, **parameters: Any) -> list[Any]:
        low = {
            name: rewriting.lower_jaxpr2(value) if getattr(value, "is_high", False) else value
            for name, value in parameters.items()
        }
        return primitive.bind(*operands, **low)

    primitive.to_lojax = to_lojax
    return primitive


def is_variable(v: Any) -> bool:
    """Whether an operand of an equation is a variable, not a literal."""
    return not hasattr(v, "val")
