"""What a device of several has of a scene: its strip of the particles, and the parts of the scene that act on these.

Forces on groups of particles, springs say, get copies of their particles, own ones and ghosts. Everything else acts on
each particle by itself.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core.component import component, replace
from jeuler.contact.collisions import Collisions
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
from jeuler.graphs.partition import Partition
from jeuler.particles.protocols import Context
from jeuler.particles.scene import Scene

PyTree = Any
STRIP = "strip"  # the axis of the mesh
COUNTED = "unresolved_contacts"  # the field of a state that is one number

# What acts on each particle by itself, with those of its fields that may have one number a particle,
ALONE: dict[type, tuple[str, ...]] = {
    Collisions: ("radius",),
    DryFriction: ("coefficient",),
    Gravity: (),
    LinearDrag: ("coefficient",),
    PenaltyContact: ("radius",),
    PointAttractor: (),
    QuadraticDrag: ("coefficient",),
}
# effects that do no more than to put particles where ``prescribe`` says: `jeuler.effects` names its own,
ON_PATHS: set[type] = set()
# and on groups of them, with the field that names these; all others but those of all groups are () or (group,).
ON_GROUPS: dict[type, str] = {
    Bending: "triples",
    CubicSprings: "edges",
    Springs: "edges",
    Strings: "edges",
    Torsion: "quads",
    Viscosity: "edges",
}
OF_ALL_GROUPS = ("box",)


def acts_alone(part: Any) -> bool:
    """Whether a force or an effect acts on each particle by itself."""
    return type(part) in ALONE or type(part) in ON_PATHS


def groups_of(scene: Scene) -> tuple[Any, ...]:
    """The arrays of groups of the forces that act on some."""
    return tuple(getattr(force, ON_GROUPS[type(force)]) for force in _on_groups(scene))


def _on_groups(scene: Scene) -> list[Any]:
    return [force for force in scene.forces if type(force) in ON_GROUPS and len(getattr(force, ON_GROUPS[type(force)]))]


def numbers_of(part: Any) -> tuple[str, ...]:
    """The fields that may have one number a particle, or a group."""
    if acts_alone(part):
        return ALONE.get(type(part), ())
    others = ON_GROUPS[type(part)], *OF_ALL_GROUPS
    return tuple(field.name for field in dataclasses.fields(part) if field.name not in others)


def _own(part: Any, which: Any) -> dict[str, Array]:
    """Those of its fields that have one number a particle, or a group, for ``which`` of these."""
    named = {name: getattr(part, name) for name in numbers_of(part)}
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


@component()
class PrescribedOnStrip:
    """The prescribed motion of those of a device's own particles that have one.

    ``rows`` are these, (prescribed,); the number of own particles, which is no row, for those of others.
    """

    motion: Any
    rows: Array

    def prescribe(self, t: Any, dtype: Any) -> tuple[Array, Array, Array, Array]:
        return self.rows, *self.motion.prescribe(t, dtype)[1:]

    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        at, p, v, _ = self.prescribe(t, state.position.dtype)
        return replace(state, position=state.position.at[at].set(p), velocity=state.velocity.at[at].set(v))


@component(static=("pairs", "max_bounces", "capacity"))
class CollisionsOnStrip(Collisions):
    """Collisions of a device's own particles with colliders; what is fast is decided beside those of all devices."""

    axis: ClassVar[str | None] = STRIP


class Cut(NamedTuple):
    """A scene for the devices of a mesh, whose `scene`, inside of ``shard_map``, is that of a device."""

    of_device: PyTree  # numbers of particles and of groups, (strip * n, ...): each has its own n
    tables: PyTree  # (strip, ...): each has its own
    of_all: PyTree  # forces and effects without these

    @classmethod
    def of(cls, scene: Scene, parts: Partition, order: Array) -> Cut:
        """The scene with its particles in this order, cut into these parts."""
        alone = [part for part in (*scene.forces, *scene.effects) if acts_alone(part)]
        groups = _on_groups(scene)
        numbers = [_own(part, order) for part in alone]
        strengths = [_own(force, which.ravel()) for force, which in zip(groups, parts.which, strict=True)]
        alone = [_without(part, own) for part, own in zip(alone, numbers, strict=True)]
        groups = [_of_copies(force, own, rows) for force, own, rows in zip(groups, strengths, parts.rows, strict=True)]
        tables = [list(x) for x in (parts.sends, parts.rows, parts.targets)]
        prescribed = [_rows_of(part, parts) if type(part) in ON_PATHS else None for part in alone]
        return cls((numbers, strengths), (tables, prescribed), (alone, groups))

    def scene(self, parts: Partition, effects: int) -> Scene:
        """That of a device; how many effects it has."""
        alone, groups = (
            [replace(part, **own) for part, own in zip(these, their_own, strict=True)]
            for these, their_own in zip(self.of_all, self.of_device, strict=True)
        )
        tables, prescribed = jax.tree.map(lambda x: x[0], self.tables)
        alone = [_on_strip(part, rows) for part, rows in zip(alone, prescribed, strict=True)]
        on_groups = (OnStrip(parts.hops, parts.strips, groups, *tables),) if groups else ()
        forces = len(alone) - effects
        return Scene((*alone[:forces], *on_groups), tuple(alone[forces:]))


def _rows_of(motion: Any, parts: Partition) -> Array:
    """(strip, prescribed), the row of each particle in the strip that has it, in others a row that none has."""
    particles = jnp.array(motion.particles, int)
    place = particles if parts.back is None else jnp.asarray(parts.back)[particles]
    own = place // parts.size == jnp.arange(parts.strips)[:, None]
    return jnp.where(own, place % parts.size, parts.size)


def _on_strip(part: Any, rows: Array | None) -> Any:
    if rows is not None:
        return PrescribedOnStrip(part, rows)
    if isinstance(part, Collisions):
        return CollisionsOnStrip(**{field.name: getattr(part, field.name) for field in dataclasses.fields(part)})
    return part
