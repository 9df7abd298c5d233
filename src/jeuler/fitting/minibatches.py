"""Descent by some rows of the data at a time."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.fitting.descent import GOES_ON, STILL, Descent, Place
from jeuler.fitting.problem import Problem

PATIENCE = 50  # passes over the data without a decrease after which the loss stands still


def by_minibatches(descent: Descent, problem: Problem, size: int, x: np.ndarray, max_iterations: int) -> Place:
    """A descent whose steps look at some rows of the data each; all of them are looked at after each pass."""
    rows, data, everything = _rows_of(problem, size), problem.data, descent.task
    weights, scale, residual = np.asarray(problem.weights, float), jnp.asarray(descent.unit), problem.residual
    ends, passes = np.cumsum([math.prod(s) for s in problem.form.shapes if s is not None]), -(-rows // size)

    def losses(z, data, weights, index):
        some = jax.tree.map(lambda a: jnp.asarray(a)[index], data)
        own = [w.reshape(rows, -1)[index].ravel() for w in jnp.split(weights, ends[:-1])]
        weight = jnp.concatenate(own)
        loss = jnp.sum(jnp.where(weight > 0, residual(z * scale, some) * weight, 0) ** 2)
        loss = loss / jnp.maximum(jnp.sum(weight > 0), 1)
        return loss, loss

    value_and_grad = jax.jit(jax.value_and_grad(losses, has_aux=True))
    propose = jax.jit(functools.partial(descent.propose, losses))

    def look(place: Place) -> tuple[Place, list[float]]:
        own = everything.all_weights
        total = float(descent.losses(place.z, everything.data, own, own)[1])
        if not np.isfinite(total):
            return place.stepped_back(descent.init, place.best_of_all, place.least_of_all), []
        return place.looked_at(total), [total]

    def iterate(place: Place) -> tuple[Place, list[float]]:
        seen: list[float] = []
        turn, part = divmod(place.turns, passes)
        if part == 0:
            before = place.least_of_all
            place, seen = look(place)
            less = place.least_of_all < (1 - descent.tolerance) * before
            place = place._replace(since=0 if less else place.since + 1)
            if place.status == GOES_ON and (place.least_of_all == 0.0 or place.since >= PATIENCE):
                place = place._replace(status=STILL)
            if place.status != GOES_ON:
                return place, seen
        order = np.resize(np.random.default_rng([0, turn]).permutation(rows), passes * size)
        index = order[part * size :][:size]
        (loss, _), gradient = value_and_grad(place.z, data, weights, index)
        place = place._replace(turns=place.turns + 1)
        if not (np.isfinite(loss) and np.isfinite(gradient).all()):
            return place.stepped_back(descent.init, place.best_of_all, place.least_of_all), seen
        z, state = propose(place.z, place.state, loss, gradient, place.damping, data, weights, index)
        return place._replace(z=z, state=state), seen

    _, place = descent.beginning(x)
    place = descent.follow(place, 0, max_iterations, iterate)
    if place.status == GOES_ON and not descent.watch.interrupted:
        place, seen = look(place)
        descent.history += seen
    return place


def _rows_of(problem: Problem, size: int) -> int:
    """How many rows the data have, or one ValueError."""
    if problem.residual.priors is not None or problem.stages:
        raise ValueError("minibatch goes without priors and stages; leave these out, or look at all data at once")
    leaves = [np.shape(leaf) for leaf in jax.tree.leaves(problem.data)]
    shapes = [shape for shape in problem.form.shapes if shape is not None]
    counts = {shape[0] if shape else 0 for shape in [*leaves, *shapes]}
    if not leaves or len(counts) != 1 or not 1 <= size <= min(counts):
        raise ValueError(
            f"minibatch must be from 1 to the rows of data, the first axis of all data and of what residual returns, "
            f"got {size} for data {leaves} and residuals {shapes}"
        )
    some = jax.tree.map(lambda a: jax.ShapeDtypeStruct((size, *jnp.shape(a)[1:]), jnp.result_type(a)), problem.data)
    x = jax.ShapeDtypeStruct((problem.layout.size,), problem.layout.dtype)
    (rows,) = counts
    try:
        found = jax.eval_shape(problem.residual, x, some).shape[0]
    except (TypeError, ValueError) as error:
        raise ValueError(f"residual must take {size} rows of the data, for minibatch; it says: {error}") from error
    if found * rows != problem.form.size * size:
        raise ValueError(f"residual must return a row for each row of data, got {found} numbers for {size} rows")
    return rows
