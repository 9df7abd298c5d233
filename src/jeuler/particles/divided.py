"""One scene over the devices of a mesh: each has a strip of the particles, and ghosts of those that act on them.

    device p:   own particles   ghosts from p - 1   ghosts from p + 1

Each device computes every spring, or other group, that holds one of its particles, so that positions and velocities
of ghosts are all that is sent, once in each evaluation of the forces, by ``lax.ppermute``. The rest is `simulate` as it
always is, of a scene that has the device's own particles.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, PartitionSpec

from jeuler._core import checks
from jeuler._core.component import component, replace, result
from jeuler._core.in_time import at_time
from jeuler.contact.penalty import PenaltyContact
from jeuler.forces import (
    Bending,
    CubicSprings,
    DryFriction,
    Gravity,
    LinearDrag,
    PointAttractor,
    QuadraticDrag,
    Springs,
    Strings,
    Torsion,
    Viscosity,
)
from jeuler.graphs.partition import Partition, partition
from jeuler.particles.fields import name_of
from jeuler.particles.protocols import Context
from jeuler.particles.scene import Scene
from jeuler.particles.state import DEFAULTS, ParticleState

PyTree = Any
STRIP = "strip"  # the axis of the mesh

# What acts on each particle by itself, with those of its fields that may have one number a particle,
ALONE: dict[type, tuple[str, ...]] = {
    DryFriction: ("coefficient",),
    Gravity: (),
    LinearDrag: ("coefficient",),
    PenaltyContact: ("radius",),
    PointAttractor: (),
    QuadraticDrag: ("coefficient",),
}
# and on groups of them, with the field that names these; all others are () or (group,).
ON_GROUPS: dict[type, str] = {
    Bending: "triples",
    CubicSprings: "edges",
    Springs: "edges",
    Strings: "edges",
    Torsion: "quads",
    Viscosity: "edges",
}


@result
class Division:
    """How a scene is divided over devices, and what they send to each other.

    Attributes:
      devices: their number, one strip each.
      particles: of a strip; the last one is filled up with pinned ones.
      ghosts: the most particles of other strips that a strip has copies of.
      messages: from one device to another, in one evaluation of the forces.
      bytes_sent: by all devices together in one evaluation of the forces: position and velocity of each ghost. A step
        of Euler's method takes one evaluation, of Heun's two, of RK4 four.
    Example:
      >>> import jax, jax.numpy as jnp, jeuler
      >>> chain = jeuler.Springs([[n, n + 1] for n in range(99)], ks=10.0, kd=0.1, rest_length=0.1)
      >>> state = jeuler.ParticleState(jnp.arange(200.0).reshape(100, 2), jnp.zeros((100, 2)))
      >>> print(jeuler.divide(jeuler.Scene((chain,)), state, devices=4))
      4 devices of 25 particles and at most 2 ghosts, 6 messages of 96 bytes in all in each evaluation of the forces
    """

    devices: int
    particles: int
    ghosts: int
    messages: int
    bytes_sent: int

    def __str__(self) -> str:
        return (
            f"{self.devices} devices of {self.particles:,} particles and at most {self.ghosts:,} ghosts, "
            f"{self.messages} messages of {self.bytes_sent:,} bytes in all in each evaluation of the forces"
        )


def divide(scene: Scene, state: ParticleState, *, devices: int) -> Division:
    """How ``simulate(scene, state, mesh=mesh)`` divides a scene over so many devices.

    The particles are ordered by reverse Cuthill-McKee, or left as they are where that sends less, and cut into strips
    of equal length.

    Args:
      scene: forces on single particles (`Gravity`, drags, `PointAttractor`, `DryFriction`, `PenaltyContact`) and on
        groups of them (`Springs`, `CubicSprings`, `Strings`, `Bending`, `Torsion`, `Viscosity`); no effects.
      state: the particles.
      devices: how many; a scene can be divided over more than there are here.
    Returns: `Division`; printed, it is one line.
    Raises: ValueError, naming the first force, effect or field that cannot be divided.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> pair = jeuler.Springs([[0, 1]], ks=10.0, kd=0.1, rest_length=1.0)
      >>> state = jeuler.ParticleState(jnp.array([[0.0], [1.5]]), jnp.zeros((2, 1)))
      >>> jeuler.divide(jeuler.Scene((pair,)), state, devices=2).bytes_sent
      16

    Source: E. Cuthill, J. McKee, Reducing the bandwidth of sparse symmetric matrices, ACM National Conference, 1969.
    """
    devices = checks.count("devices", devices, least=1)
    check_divisible(scene, state)
    scene.check(state)
    parts = partition(groups_of(scene), len(state.position), devices)
    most = sum(rows.shape[1] for rows in parts.sends)
    each = 2 * state.position.shape[1] * state.position.dtype.itemsize
    messages = sum(devices - abs(h) for h in parts.hops)
    return Division(devices, parts.size, most, messages, each * parts.sent())


def check_divisible(scene: Scene, state: ParticleState) -> None:
    """One ValueError that names the first force, effect or field that cannot be divided."""
    for part in (*scene.forces, *scene.effects):
        if type(part) not in (*ALONE, *ON_GROUPS):
            able = ", ".join(sorted(kind.__name__ for kind in (*ALONE, *ON_GROUPS)))
            raise ValueError(
                f"mesh must be None with {name_of(part)}, which may act on any particles; what can be divided is {able}"
            )
        for name in _numbers_of(part) if type(part) in ON_GROUPS else ():
            value = getattr(part, name)
            if callable(value) and checks.form_of(name, at_time, value, 0.0).shape != ():
                raise ValueError(
                    f"mesh must be None with {name_of(part)}.{name} that is a function of time with a number for each, "
                    f"got one; give one number for all, or numbers that stay"
                )
    for name in state.fields():
        if name not in ("position", "velocity", "mass", *DEFAULTS) or name == "alive":
            able = ", ".join(("position", "velocity", "mass", *sorted({*DEFAULTS} - {"alive"})))
            raise ValueError(f"mesh must be None with state.{name}; what can be divided is {able}")


def check_division(
    scene: Scene, state: ParticleState, mesh: Any, step: Any, checkpoint: Any, how: dict[str, Any]
) -> Partition:
    """The `Partition` of a run with these arguments of `simulate`; one ValueError if it cannot be divided."""
    if not isinstance(mesh, Mesh):
        hint = 'write mesh=jax.make_mesh((jax.device_count(),), ("device",))'
        raise ValueError(f"mesh must be a jax.sharding.Mesh, got {checks.shown(mesh)}; {hint}")
    for name, value in how.items():
        if value is not None and value is not False and value != ():
            raise ValueError(f"{name} must not be given with mesh, a run in one piece, got {checks.shown(value)}")
    if checkpoint == "reversible":
        raise ValueError('checkpoint must not be "reversible" with mesh; take checkpoint="sqrt"')
    if not hasattr(step, "increment"):
        raise ValueError(
            f"step must be explicit with mesh, got {name_of(step)}, which may need all particles at once; "
            f"take euler_step, symplectic_euler_step, heun_step or rk4_step"
        )
    check_divisible(scene, state)
    return partition(groups_of(scene), len(state.position), mesh.size)


def groups_of(scene: Scene) -> tuple[Any, ...]:
    """The arrays of groups of the forces that act on some."""
    return tuple(getattr(force, ON_GROUPS[type(force)]) for force in _on_groups(scene))


def _on_groups(scene: Scene) -> list[Any]:
    return [force for force in scene.forces if type(force) in ON_GROUPS and len(getattr(force, ON_GROUPS[type(force)]))]


def _numbers_of(part: Any) -> tuple[str, ...]:
    """The fields that may have one number a particle, or a group."""
    if type(part) in ALONE:
        return ALONE[type(part)]
    return tuple(field.name for field in dataclasses.fields(part) if field.name != ON_GROUPS[type(part)])


def _own(part: Any, which: Any) -> dict[str, Array]:
    """Those of its fields that have one number a particle, or a group, for ``which`` of these."""
    named = {name: getattr(part, name) for name in _numbers_of(part)}
    return {name: x[which] for name, x in named.items() if getattr(x, "ndim", 0)}


def _without(part: Any, own: dict[str, Array], **changes: Any) -> Any:
    """The part without these numbers, which `_with` puts in again."""
    return replace(part, **dict.fromkeys(own, 0.0), **changes)


def _of_copies(force: Any, own: dict[str, Array], rows: Array) -> Any:
    """The force between copies of its particles, the first of all groups first, without its own numbers."""
    _, k, count = rows.shape
    return _without(force, own, **{ON_GROUPS[type(force)]: np.arange(k * count).reshape(k, count).T})


@component(static=("hops", "strips"))
class OnStrip:
    """The forces on groups, of a device's own particles and ghosts: a force on its own particles.

    Each force gets copies of the particles of its groups, and what it gives to these is added up.
    """

    hops: tuple[int, ...]
    strips: int
    forces: list[Any]
    sends: list[Array]
    rows: list[Array]
    targets: list[Array]

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        motion = self.with_ghosts(jnp.concatenate([position, velocity], axis=1))
        total, dim = jnp.zeros_like(position), position.shape[1]
        for force, rows, target in zip(self.forces, self.rows, self.targets, strict=True):
            copies = motion[rows.ravel()]
            share = force(t, copies[:, :dim], copies[:, dim:], jnp.ones_like(copies[:, 0]))
            total = total.at[target.ravel()].add(share, mode="drop")
        return total

    def with_ghosts(self, x: Array) -> Array:
        """x of the own particles, (particle, n), and below it that of the ghosts."""
        parts = [x]
        for hop, rows in zip(self.hops, self.sends, strict=True):
            path = [(p, p + hop) for p in range(self.strips) if 0 <= p + hop < self.strips]
            parts.append(lax.ppermute(x[rows], STRIP, path))
        return jnp.concatenate(parts)

    def prepare(self, context: Context) -> OnStrip:
        """With each force prepared for its copies."""

        def prepared(force, rows):
            own = dataclasses.replace(context, particles=rows.size)
            return force.prepare(own) if hasattr(force, "prepare") else force

        return replace(self, forces=[prepared(*each) for each in zip(self.forces, self.rows, strict=True)])


Fields = tuple[Array, ParticleState, Array]  # t, y, first_nonfinite


def run_divided(
    run: Callable[..., Fields], scene: Scene, state: ParticleState, grid: Any, parts: Partition, mesh: Mesh
) -> Fields:
    """t, y and first_nonfinite of a `Solution`, where ``run(scene, state, grid)`` gives those of one device."""
    particles, one_each = len(state.position), jnp.ndim(state.mass) > 0
    alone = [part for part in scene.forces if type(part) in ALONE]
    groups = _on_groups(scene)
    state, order = _in_order(state, parts)
    numbers = [_own(part, order) for part in alone]
    strengths = [_own(force, which.ravel()) for force, which in zip(groups, parts.which, strict=True)]
    alone = [_without(part, own) for part, own in zip(alone, numbers, strict=True)]
    groups = [_of_copies(force, own, rows) for force, own, rows in zip(groups, strengths, parts.rows, strict=True)]

    def on_device(of_device, tables, of_all):
        (state, *of_parts), (*parts_of_all, grid) = of_device, of_all
        alone, groups = (
            [replace(part, **own) for part, own in zip(these, their_own, strict=True)]
            for these, their_own in zip(parts_of_all, of_parts, strict=True)
        )
        tables = jax.tree.map(lambda x: x[0], tables)
        on_groups = (OnStrip(parts.hops, parts.strips, groups, *tables),) if groups else ()
        t, y, first_nonfinite = run(Scene((*alone, *on_groups)), state, grid)
        return t, y, _first(first_nonfinite)

    each, all_ = PartitionSpec(STRIP), PartitionSpec()
    strips = Mesh(mesh.devices.ravel(), (STRIP,))
    run_all = jax.shard_map(
        on_device,
        mesh=strips,
        in_specs=(each, each, all_),
        out_specs=(all_, PartitionSpec(None, STRIP), all_),
        check_vma=False,
    )
    tables = [list(x) for x in (parts.sends, parts.rows, parts.targets)]
    t, y, first_nonfinite = run_all((state, numbers, strengths), tables, (alone, groups, grid))
    back = slice(particles) if parts.back is None else parts.back
    y = jax.tree.map(lambda x: x[:, back], y)
    return t, y if one_each else replace(y, mass=y.mass[:, 0]), first_nonfinite


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
