"""Hints that make XLA:CPU materialise a value instead of recomputing it in every consumer.

XLA fuses what it considers cheap into each of its consumers, and so computes it again for each. It never duplicates a
division: these are divisions by 1 and subtractions of 0 that are not constants to XLA. LLVM, which runs after it, knows
that no float is greater than inf, and removes them, so that the hint itself costs nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jax.interpreters import ad, batching, mlir

from jeuler._jax import batch_last
from jeuler._jax.jaxpr import Primitive
from jeuler._jax.placed import typed
from jeuler._jax.platforms import CPU

stored_p = Primitive("stored")


def stored(x: Array) -> Array:
    """x and its cotangent, each computed once and stored, not again for each of its uses."""
    return stored_p.bind(x)


@jax.custom_jvp
def kept(x: Array) -> Array:
    """x, stored if the program is differentiated.

    There x is often a row of the stack of saved states. XLA would read that row in every kernel that uses x, and the
    loop counter again for each of its elements.
    """
    return x


@kept.defjvp
def _kept_jvp(primals, tangents):
    return stored(*primals), tangents[0]


def padded(x: Array, width: int) -> Array:
    """x with ``width`` zeros before and after it, along its last axis.

    A pad by itself runs through an older, slower loop of XLA than one that is fused with arithmetic.
    """
    return jnp.pad(x - jnp.where(x > jnp.inf, 1, 0).astype(x.dtype), [(0, 0)] * (x.ndim - 1) + [(width, width)])


def as_stored(x: Array) -> Array:
    """The arithmetic of `stored`, for use inside other primitives."""
    return x / jnp.where(x > jnp.inf, 2, 1).astype(x.dtype)


stored_p.def_impl(lambda x: x)
stored_p.def_abstract_eval(typed(as_stored, lambda x: jax.core.ShapedArray(x.shape, x.dtype)))
mlir.register_lowering(stored_p, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(stored_p, mlir.lower_fun(as_stored, multiple_results=False), platform=CPU)
ad.deflinear2(stored_p, lambda cotangent, x: [stored(cotangent)])
batching.defvectorized(stored_p)
batch_last.written_out[stored_p] = as_stored
