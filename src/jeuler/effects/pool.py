"""The slots of a pool: which are free, what newborns are given, and how they are put in."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.components import by_component
from jeuler.particles.state import COUNTERS, DEFAULTS, ParticleState
from jeuler.samplers.base import as_sampler, draw

OPTIONAL = ("mass", "lifetime", "color", "opacity", "size", "shape")


def store_samplers(effect: Any, *required: str) -> None:
    """Turn what newborns are given into samplers; one ValueError if a value is none, or out of range."""
    kind = type(effect).__name__
    if effect.max_births is not None:
        checks.count(f"{kind}.max_births", effect.max_births, least=1)
    for name in (*required, *OPTIONAL):
        value = getattr(effect, name)
        if value is None and name in required:
            raise ValueError(f"{kind}.{name} must be a sampler such as FromDisc(...), or one vector, got None")
        object.__setattr__(effect, name, as_sampler(f"{kind}.{name}", value))
    for name, unit in (("lifetime", "s"), ("mass", "kg")):
        value = getattr(effect, name)
        if value is not None and not callable(value):
            checks.above_zero(f"{kind}.{name}", value, unit)
    if effect.extra is not None:
        if not isinstance(effect.extra, dict):
            raise ValueError(f"{kind}.extra must be a dict of samplers by name, got {checks.shown(effect.extra)}")
        extra = {name: as_sampler(f"{kind}.extra[{name!r}]", x) for name, x in effect.extra.items()}
        object.__setattr__(effect, "extra", extra)


def samplers_of(effect: Any) -> dict[str, Any]:
    """What newborns are given beside position and velocity, by the name of the field."""
    named = {name: getattr(effect, name) for name in OPTIONAL if getattr(effect, name) is not None}
    return {**named, **(effect.extra or {})}


def fields_of_births(effect: Any) -> dict[str, Any]:
    """The fields that births write, with the shape of one particle's value in those that are not the library's own."""

    def one(sampler):
        return jax.eval_shape(lambda key: draw(sampler, key, 1), jax.random.key(0)).shape[1:]

    further = {name: one(sampler) for name, sampler in (effect.extra or {}).items()}
    return {**dict.fromkeys(("alive", *COUNTERS, *samplers_of(effect)), ()), **further}


def most_births(effect: Any, particles: int) -> int:
    """The most births in a step: for so many newborns values are drawn."""
    return min(effect.max_births or particles, particles)


def check_sampled_vectors(effect: Any, names: tuple[str, ...], particles: int, dim: int) -> None:
    """ValueError unless these samplers give each newborn one number a dimension."""
    count = most_births(effect, particles)
    for name in names:
        shape = jax.eval_shape(lambda key, name=name: draw(getattr(effect, name), key, count), jax.random.key(0)).shape
        if shape != (count, dim):
            raise ValueError(
                f"{type(effect).__name__}.{name} must give each newborn ({dim},) numbers, one a dimension, "
                f"got {shape[1:]}"
            )


def put_newborns(
    effect: Any, state: ParticleState, slot: Array, births: Array, wanted: Array, values: dict[str, Array]
) -> ParticleState:
    """The state with the first ``births`` of the newborns in their slots, and ``wanted`` of them counted.

    A field that is not among the values gets its default, one of the user's own 0; a slot keeps its mass.
    """
    capacity, block = len(state.position), len(slot)
    slot = jnp.where(jnp.arange(block) < births, slot, capacity)

    def put(name: str, x: Array, newborn: Array) -> Array:
        if newborn.shape != (block, *x.shape[1:]):
            raise ValueError(
                f"{type(effect).__name__}.{name} must give each newborn a value of shape {x.shape[1:]}, "
                f"got {newborn.shape[1:]}"
            )

        def into(x: Array, newborn: Array) -> Array:
            return x.at[slot].set(newborn.astype(x.dtype), mode="drop")

        return by_component(into, x, newborn) if name in ("position", "velocity") else into(x, newborn)

    values = dict(values)
    for name in state.fields():
        x = getattr(state, name)
        if name in values or name == "mass":
            continue
        if name in DEFAULTS:
            shape, value = DEFAULTS[name]
            values[name] = jnp.full((block, *shape), value)
        elif x.shape[:1] == (capacity,):
            values[name] = jnp.zeros((block, *x.shape[1:]), x.dtype)
    new = {name: put(name, getattr(state, name), value) for name, value in values.items()}
    missed = add_up(state.missed_births, wanted - births)
    return state.replace(**new, births=add_up(state.births, births), missed_births=missed)


def add_up(count: Array, more: Array) -> Array:
    """count + more, and the greatest number there is where that is above it."""
    most = jnp.iinfo(count.dtype).max
    return jnp.where(count > most - more, most, count + more)


def first_free(alive: Array, count: int) -> tuple[Array, Array]:
    """The first ``count`` free slots in order, and how many are free in all; past these the slots mean nothing.

    By words of 32 slots, a bit each: the running sum goes over words, not slots, and the n-th bit of a word is found
    by counting in it.
    """
    words = -(-len(alive) // 32)
    free = jnp.pad(~alive, (0, 32 * words - len(alive))).reshape(words, 32)
    lane = jnp.arange(32, dtype=jnp.uint32)
    bits = jnp.sum(free.astype(jnp.uint32) << lane, axis=1, dtype=jnp.uint32)
    in_word = lax.population_count(bits).astype(jnp.int32)
    up_to = jnp.cumsum(in_word)
    rank = jnp.arange(count, dtype=jnp.int32)
    word = jnp.minimum(jnp.searchsorted(up_to, rank, side="right", method="scan_unrolled"), words - 1)
    left = rank - (up_to - in_word)[word]  # set bits of this word to pass by
    up_to_lane = bits[word][:, None] & (jnp.uint32(0xFFFFFFFF) >> (31 - lane))
    bit = jnp.sum(lax.population_count(up_to_lane).astype(jnp.int32) <= left[:, None], axis=1, dtype=jnp.int32)
    return 32 * word + bit, up_to[-1]
