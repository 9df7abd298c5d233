"""A value that a search has found, with the derivatives of the function that it is the value of.

``jax.custom_jvp`` could say so too, but reverse mode in a ``lax.scan`` keeps no such rule for a second derivative; the
rule of a primitive stays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.interpreters import ad, batching, mlir

from jeuler._jax.jaxpr import evaluate, holding_programs

# Operands: the value's arrays, then what the program reads. Parameters: ``program``, a closed jaxpr of the latter to
# what the value's arrays are; ``count``, how many these are.
found_p = holding_programs("found")


def found(value: Any, function: Callable[[], Any]) -> Any:
    """The value, a pytree of floating arrays; its derivatives, in both modes and of any order, are those of
    ``function()``, which is what the value is, and is not evaluated where no derivative is asked for."""
    leaves, form = jax.tree.flatten(value)
    traced = jax.make_jaxpr(function)()
    read = traced.consts
    program = jax.make_jaxpr(lambda *read: jax.core.eval_jaxpr(traced.jaxpr, read))(*read)
    results = found_p.bind(*map(lax.stop_gradient, leaves), *read, program=program, count=len(leaves))
    return jax.tree.unflatten(form, results)


@found_p.def_impl
def _run(*operands, program, count):
    return operands[:count]


mlir.register_lowering(found_p, lambda context, *operands, program, count: operands[:count])


@found_p.def_abstract_eval
def _avals(*operands, program, count):
    return program.out_avals


def _jvp(primals, tangents, *, program, count):
    results = found_p.bind(*primals, program=program, count=count)
    read, changes = primals[count:], tangents[count:]
    moving = [n for n, change in enumerate(changes) if type(change) is not ad.Zero]
    if not moving:
        return results, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in results]

    def of_moving(*moved):
        operands = list(read)
        for n, x in zip(moving, moved, strict=True):
            operands[n] = x
        return evaluate(program, operands)

    return results, jax.jvp(of_moving, [read[n] for n in moving], [changes[n] for n in moving])[1]


ad.primitive_jvps[found_p] = _jvp


def _batch(operands, axes, *, program, count):
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)

    def first(x, axis):
        return jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)

    value = list(map(first, operands[:count], axes[:count]))
    read = operands[count:]
    function = jax.vmap(lambda *read: evaluate(program, read), in_axes=axes[count:], axis_size=size)
    results = found_p.bind(*value, *read, program=jax.make_jaxpr(function)(*read), count=count)
    return results, [0] * count


batching.primitive_batchers[found_p] = _batch
