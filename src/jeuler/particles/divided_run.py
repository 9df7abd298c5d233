"""The run of one scene over the devices of a mesh: `simulate` as it always is, of the scene that each device has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.sharding import Mesh, PartitionSpec

from jeuler._core.component import replace
from jeuler.graphs.partition import Partition
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, join_state, split_state
from jeuler.particles.step import SceneStep
from jeuler.particles.strips import STRIP, Cut
from jeuler.solving._scan import no_remainder
from jeuler.solving.grid import Grid
from jeuler.solving.loop import Loop
from jeuler.steps.explicit import Step

PyTree = Any
Fields = tuple[Array, ParticleState, Array]  # t, y, first_nonfinite
EACH, ALL = PartitionSpec(STRIP), PartitionSpec()


def run_divided(
    run: Callable[..., Fields], scene: Scene, state: ParticleState, grid: Any, parts: Partition, mesh: Mesh
) -> Fields:
    """t, y and first_nonfinite of a `Solution`, where ``run(scene, state, grid)`` gives those of one device."""
    particles, one_each = len(state.position), jnp.ndim(state.mass) > 0
    before = 0 if state.unresolved_contacts is None else state.unresolved_contacts
    state, order = _in_order(replace(state, unresolved_contacts=None), parts)
    counts = any("unresolved_contacts" in getattr(effect, "writes", ()) for effect in scene.effects)

    def on_device(state, cut, grid):
        t, y, first_nonfinite = run(cut.scene(parts, len(scene.effects)), state, grid)
        count = lax.psum(y.unresolved_contacts, STRIP) if counts else None
        return t, replace(y, unresolved_contacts=None), count, _first(first_nonfinite)

    run_all = jax.shard_map(
        on_device,
        mesh=_strips(mesh),
        in_specs=(EACH, Cut(EACH, EACH, ALL), ALL),
        out_specs=(ALL, PartitionSpec(None, STRIP), ALL, ALL),
        check_vma=False,
    )
    t, y, count, first_nonfinite = run_all(state, Cut.of(scene, parts, order), grid)
    y = jax.tree.map(lambda x: x[:, _back(parts, particles)], y)
    y = y if one_each else replace(y, mass=y.mass[:, 0])
    return t, y if count is None else replace(y, unresolved_contacts=before + count), first_nonfinite


def divided_loop(
    scene: Scene,
    state: ParticleState,
    grid: Grid,
    parts: Partition,
    mesh: Mesh,
    step: Step,
    save: Callable[[Array, ParticleState], Any] | None,
    compensated: bool,
) -> Loop:
    """The loop of a run in pieces, from the first state of the undivided one; between steps it is on the devices."""
    particles, one_each = len(state.position), jnp.ndim(state.mass) > 0
    counted = state.unresolved_contacts
    ordered, order = _in_order(replace(state, unresolved_contacts=None), parts)
    if counted is not None:  # one number a device, which add up
        ordered = replace(ordered, unresolved_contacts=jnp.zeros(parts.strips, jnp.int32).at[0].set(counted))
    cut = Cut.of(scene, parts, order)
    motion, rest = split_state(ordered)

    def on_device(carried, cut, n, t, grid):
        (motion, rest), remainder = carried
        if counted is not None:
            rest = replace(rest, unresolved_contacts=rest.unresolved_contacts[0])
        own, state = cut.scene(parts, len(scene.effects)), join_state((motion, rest))
        run = SceneStep.of(own, state, grid, step, None, compensated=compensated)
        (motion, rest), remainder = run(n, t, ((motion, rest), remainder))
        if counted is not None:
            rest = replace(rest, unresolved_contacts=rest.unresolved_contacts[None])
        return (motion, rest), remainder

    on_devices = jax.shard_map(
        on_device,
        mesh=_strips(mesh),
        in_specs=(EACH, Cut(EACH, EACH, ALL), ALL, ALL, ALL),
        out_specs=EACH,
        check_vma=False,
    )

    def saved(t, carried):
        y = join_state(carried)
        count = None if counted is None else jnp.sum(y.unresolved_contacts, dtype=jnp.int32)
        y = jax.tree.map(lambda x: x[_back(parts, particles)], replace(y, unresolved_contacts=None))
        y = replace(y if one_each else replace(y, mass=y.mass[0]), unresolved_contacts=count)
        return y if save is None else save(t, y)

    return Loop(
        lambda n, t, carried: on_devices(carried, cut, n, t, grid),
        ((motion, rest), no_remainder(motion, compensated)),
        grid,
        saved,
        watch=lambda carried: carried[0],
        unresolved=lambda carried: (
            None if counted is None else jnp.sum(carried[1].unresolved_contacts, dtype=jnp.int32)
        ),
    )


def _strips(mesh: Mesh) -> Mesh:
    return Mesh(mesh.devices.ravel(), (STRIP,))


def _back(parts: Partition, particles: int) -> Any:
    """Where each particle is in the order of the strips."""
    return slice(particles) if parts.back is None else parts.back


def _in_order(state: ParticleState, parts: Partition) -> tuple[ParticleState, Array]:
    """The state in the order of the strips, filled up with copies of the last particle, pinned; and that order."""
    particles = len(state.position)
    place = jnp.arange(parts.strips * parts.size)
    order = jnp.minimum(place, particles - 1)
    order = order if parts.order is None else jnp.asarray(parts.order)[order]
    mass = jnp.broadcast_to(state.mass, (particles,))
    state = jax.tree.map(lambda x: x[order], replace(state, mass=mass))
    return replace(state, mass=jnp.where(place < particles, state.mass, jnp.inf)), order


def _first(first_nonfinite: Array) -> Array:
    """The least over all devices of those that are not -1."""
    never = jnp.iinfo(first_nonfinite.dtype).max
    first = lax.pmin(jnp.where(first_nonfinite < 0, never, first_nonfinite), STRIP)
    return jnp.where(first == never, -1, first)
