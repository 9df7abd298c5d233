"""A run on arrays of a mesh, as one equation whose inside knows nothing of the mesh.

Inside ``jax.shard_map``, and in a batch over explicit axes of a mesh, JAX asks of each loop that its carry begin with
the types it ends with. The loops of other libraries within a step begin with constants, which belong to no mesh, and
are refused. Here the run is traced as it is without a mesh. The equation `apart_p` that holds it says how its results
vary; its derivatives and batches are again such equations, and the compiler divides the work. Reverse mode keeps the
operands of the run alone, and does it again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax._src import mesh as meshes  # the mesh of none has no public name
from jax.interpreters import ad, batching, mlir
from jax.sharding import NamedSharding, PartitionSpec

from jeuler._jax.batch_last import reached
from jeuler._jax.jaxpr import Jaxpr, evaluate, holding_programs
from jeuler._jax.members import _batched, _chosen, _merged, _others, _tangent, _transposed
from jeuler._jax.placed import (
    as_varying,
    bare,
    explicit_mesh,
    is_placed,
    manual_axes,
    told_of_axes,
    type_of,
    varying_axes,
)

PyTree = Any

apart_p = holding_programs("apart")


@contextlib.contextmanager
def _no_mesh() -> Iterator[None]:
    with jax.sharding.use_abstract_mesh(meshes.empty_abstract_mesh):
        yield


def apart(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """function(*operands), pytrees of arrays, traced without the mesh that these are on, if any.

    A result is divided over explicit axes as the first operand of its shape, or of its shape without a leading axis. A
    function that talks to other devices by the name of an axis is called as it is.
    """

    def call(*operands):
        leaves, structure = jax.tree.flatten(operands)
        if not (manual_axes() or any(map(is_placed, leaves))):
            return function(*operands)
        forms = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves]
        with _no_mesh():
            try:
                of_leaves = jax.make_jaxpr(lambda *x: function(*jax.tree.unflatten(structure, x)), return_shape=True)
                jaxpr, form = of_leaves(*forms)
            except Exception:  # of many kinds where an axis is talked to by its name; others come again below
                jaxpr = None
        if jaxpr is None or jaxpr.effects or any(map(is_placed, jaxpr.consts)):
            return function(*operands)
        results = _bind([*jaxpr.consts, *leaves], _with_operands_for_consts(jaxpr))
        return jax.tree.unflatten(jax.tree.structure(form), _divided(results, leaves))

    return call


def _with_operands_for_consts(jaxpr: Jaxpr) -> Jaxpr:
    count = len(jaxpr.consts)
    forms = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in map(bare, [*jaxpr.consts, *jaxpr.in_avals])]
    with _no_mesh():
        return jax.make_jaxpr(lambda *x: jax.core.eval_jaxpr(jaxpr.jaxpr, x[:count], *x[count:]))(*forms)


def _bind(operands: list, jaxpr: Jaxpr) -> list:
    axes = frozenset().union(*map(varying_axes, operands))
    return apart_p.bind(*(as_varying(x, axes) for x in operands), jaxpr=jaxpr)


def _divided(results: list, operands: list) -> list:
    """The results, divided as operands of their shapes are."""
    specs: dict[tuple[int, ...], Any] = {}
    for x in operands:
        mesh = explicit_mesh(x)
        if mesh is not None and any(type_of(x).sharding.spec):
            specs.setdefault(jnp.shape(x), (mesh, tuple(type_of(x).sharding.spec)))

    def divided(x):
        if x.shape in specs:
            return _placed(x, *specs[x.shape])
        if x.shape[1:] in specs:
            mesh, spec = specs[x.shape[1:]]
            return _placed(x, mesh, (None, *spec))
        return x

    return list(map(divided, results))


def _placed(x: Any, mesh: Any, spec: tuple) -> Any:
    return jax.sharding.reshard(x, NamedSharding(mesh, PartitionSpec(*spec)))


@apart_p.def_impl
def _run(*operands, jaxpr):
    return evaluate(jaxpr, operands)


@apart_p.def_abstract_eval
def _types(*operands, jaxpr):
    axes = frozenset().union(*map(varying_axes, operands))
    mesh = next((mesh for mesh in map(explicit_mesh, operands) if mesh is not None), None)

    def type_(result):
        plain = bare(result)
        if axes:
            like = next(x for x in operands if varying_axes(x) == axes)
            return plain.update(sharding=_nowhere(like.sharding.mesh, plain), **told_of_axes(like))
        return plain if mesh is None else plain.update(sharding=_nowhere(mesh, plain))

    return list(map(type_, jaxpr.out_avals))


def _nowhere(mesh: Any, type_: Any) -> NamedSharding:
    return NamedSharding(mesh, PartitionSpec(*[None] * len(type_.shape)))


def _lowered(context, *operands, jaxpr):
    without = context.replace(avals_in=list(map(bare, context.avals_in)), avals_out=list(map(bare, context.avals_out)))
    with _no_mesh():
        return mlir.lower_fun(lambda *x: evaluate(jaxpr, x), multiple_results=True)(without, *operands)


def _jvp(primals, tangents, *, jaxpr):
    results = _bind(list(primals), jaxpr)
    moving = tuple(type(x) is not ad.Zero and jnp.issubdtype(x.dtype, jnp.inexact) for x in tangents)
    with _no_mesh():
        tangent, used = _tangent(jaxpr, moving)
    return results, _bind(_chosen([*primals, *_chosen(tangents, moving)], used), tangent)


def _transpose(cotangents, *operands, jaxpr):
    linear = tuple(map(ad.is_undefined_primal, operands))
    given = tuple(type(x) is not ad.Zero for x in cotangents)
    with _no_mesh():
        transposed, used = _transposed(jaxpr, linear, given)
    inputs = [*_chosen(operands, _others(linear)), *_chosen(cotangents, given)]
    results = _bind(_chosen(inputs, used), transposed)

    def of_operand(x, operand):
        mesh = explicit_mesh(operand.aval)
        return x if mesh is None else _placed(x, mesh, tuple(operand.aval.sharding.spec))

    totals = map(of_operand, results, _chosen(operands, linear))
    return _merged(linear, totals, [None] * len(linear))


def _batch(axis_data, operands, axes, *, jaxpr):
    new = tuple(axis is not None for axis in axes)
    operands = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes, strict=True)]
    with _no_mesh():
        batched = _batched(jaxpr, new, axis_data.size)
    results = _bind(operands, batched)
    reach = reached(jaxpr.jaxpr, new)
    name = getattr(axis_data, "explicit_mesh_axis", None)
    mesh = next((mesh for mesh in map(explicit_mesh, operands) if mesh is not None), None)
    if name is not None and mesh is not None:
        results = [
            _placed(x, mesh, (name, *[None] * (x.ndim - 1))) if r else x for x, r in zip(results, reach, strict=True)
        ]
    return results, [0 if r else None for r in reach]


mlir.register_lowering(apart_p, _lowered)
ad.primitive_jvps[apart_p] = _jvp
ad.primitive_transposes[apart_p] = _transpose
batching.fancy_primitive_batchers[apart_p] = _batch
