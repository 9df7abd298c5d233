"""Whether anything is true anywhere, in all members of a batch: what decides whether a piece of work can be skipped.

Under ``vmap`` a condition of one's own for each member makes ``lax.cond`` run both its branches for all of them. This
one is the same for all, and so the branch is run only if one of the members needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.interpreters import ad, batching, mlir

from jeuler._jax.jaxpr import Primitive
from jeuler._jax.placed import typed

anywhere_p = Primitive("anywhere")


def anywhere(what: Array) -> Array:
    """One boolean: whether ``what`` is true in any place and in any member of the batches around."""
    return anywhere_p.bind(what)


def where_needed(needed: Array, work: Callable[..., Any], otherwise: Any, *operands: Any) -> Any:
    """``work(*operands)`` where needed, (); ``otherwise``, of the same form, elsewhere.

    In a batch the work is skipped if no member needs it, and no member gets what only another one needs.
    """
    result = lax.cond(anywhere(needed), work, lambda *_: otherwise, *operands)
    return jax.tree.map(lambda done, not_done: jnp.where(needed, done, not_done), result, otherwise)


anywhere_p.def_impl(jax.jit(jnp.any))
anywhere_p.def_abstract_eval(typed(jnp.any, lambda what: jax.core.ShapedArray((), bool)))
mlir.register_lowering(anywhere_p, mlir.lower_fun(jnp.any, multiple_results=False))
ad.primitive_jvps[anywhere_p] = lambda primals, _: (
    anywhere_p.bind(*primals),
    ad.Zero(jax.core.ShapedArray((), jax.dtypes.float0)),
)
batching.primitive_batchers[anywhere_p] = lambda operands, _: (anywhere_p.bind(*operands), None)
