"""Descent by an optax optimiser as part of a program that is being traced: that of `descent`, in loops of JAX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler.fitting import least_squares
from jeuler.fitting.descent import NEAR, PATIENCE
from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import CONVERGED, STALLED, State, Task
from jeuler.fitting.losses import LOSSES
from jeuler.fitting.options import Options


class _Place(NamedTuple):
    z: Array
    state: Any
    damping: Array
    best: Array
    least: Array
    since: Array
    turns: Array
    nonfinite: Array
    history: Array


def descended(
    evaluate: Evaluate, stages: Sequence[Any], options: Options, unit: Array, state: State, task: Task
) -> State:
    """Through the stages, then over everything, in z = x / unit; the Jacobian at the end says how near it came."""
    most = options.max_iterations
    z = state.x / unit
    if stages:
        some = min(most, most // 4 + 10)
        weights = jnp.stack([jnp.asarray(w, z.dtype) for w in stages])
        place, _ = lax.scan(
            lambda place, w: (_stage(evaluate, options, unit, place.best, task._replace(weights=w), some, place), None),
            _beginning(options.optimizer, z, most),
            weights,
        )
        z, lost = place.best, place.nonfinite
    else:
        lost = jnp.zeros((), jnp.int32)
    place = _stage(evaluate, options, unit, z, task, most, _beginning(options.optimizer, z, most))
    state = least_squares.start(place.best * unit, len(task.weights), most)
    state = least_squares.advance(evaluate, LOSSES["linear"], state, task, 1)
    return state._replace(
        x=place.best * unit,
        status=jnp.where(state.offset <= NEAR, CONVERGED, STALLED),
        iterations=place.turns,
        nonfinite=place.nonfinite + lost,
        history=place.history,
    )


def _beginning(optimizer: Any, z: Array, most: int) -> _Place:
    number, count = jnp.ones((), z.dtype), jnp.zeros((), jnp.int32)
    history = jnp.full(most, jnp.nan, z.dtype)
    return _Place(z, optimizer.init(z), number, z, number * jnp.inf, count, count, count, history)


def _stage(
    evaluate: Evaluate, options: Options, unit: Array, z: Array, task: Task, most: int, before: _Place
) -> _Place:
    """Down to where the loss over what is weighted stands still."""
    import optax

    optimizer = optax.with_extra_args_support(options.optimizer)
    size = jnp.maximum(jnp.sum(task.weights > 0), 1)

    def losses(z: Array) -> tuple[Array, Array]:
        raw = evaluate.residual(z * unit, task.data)
        some, everything = (jnp.sum(jnp.where(w > 0, raw * w, 0) ** 2) for w in (task.weights, task.all_weights))
        return some / size, everything

    def goes_on(place: _Place) -> Array:
        return (place.turns < most) & (place.since < PATIENCE) & (place.least > 0)

    def turn(place: _Place) -> _Place:
        (loss, total), gradient = jax.value_and_grad(losses, has_aux=True)(place.z)
        finite = jnp.isfinite(loss) & jnp.all(jnp.isfinite(gradient))
        better = finite & (loss < place.least)
        best = jnp.where(better, place.z, place.best)
        updates, state = optimizer.update(
            gradient, place.state, place.z, value=loss, grad=gradient, value_fn=lambda z: losses(z)[0]
        )
        moved = optax.apply_updates(place.z, jax.tree.map(lambda u: place.damping * u, updates))
        z = jnp.where(finite, jnp.clip(moved, task.lower / unit, task.upper / unit), best)
        return _Place(
            z=z,
            state=jax.tree.map(lambda new, old: jnp.where(finite, new, old), state, optimizer.init(best)),
            damping=jnp.where(finite, place.damping, place.damping / 2),
            best=best,
            least=jnp.where(better, loss, place.least),
            since=jnp.where(finite & (loss < (1 - options.tolerance) * place.least), 0, place.since + 1),
            turns=place.turns + 1,
            nonfinite=place.nonfinite + ~finite,
            history=jnp.where(finite, place.history.at[place.turns].set(total), place.history),
        )

    begun = _beginning(options.optimizer, z, len(before.history))
    return lax.while_loop(goes_on, turn, begun._replace(nonfinite=before.nonfinite))
