"""The equation of motion of a scene: forces in the form that the loop calls, and what they read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.component import component
from jeuler._core.components import by_component, split, stack
from jeuler._core.vectors import total
from jeuler.forces.drag import Flow, once
from jeuler.forces.drag import acceleration as limited_acceleration
from jeuler.particles.fields import declared, name_of
from jeuler.particles.protocols import Context
from jeuler.steps.explicit import is_explicit_of_first_order


@component()
class Attributes:
    """What the equation of motion takes beside time, position and velocity.

    Attributes:
      mass: () or (particle,), kg; inf for a pinned particle and for a dead slot.
      alive: (particle,), boolean; None where all are.
      others: the fields that some force reads, by name.
    """

    mass: Any
    alive: Any = None
    others: Any = None

    def field(self, name: str, reader: str) -> Array:
        """A field that a force reads; ValueError if it is not there."""
        if name in ("mass", "alive"):
            return getattr(self, name)
        if name not in (self.others or {}):
            raise ValueError(f"{reader} reads {name!r}, got a mass alone; pass args=scene.attributes(state)")
        return self.others[name]


class Prepared(NamedTuple):
    """A force of a scene in the form that the loop calls."""

    name: str
    reads: tuple[str, ...]
    kernel: Callable[..., Array]


class Share(NamedTuple):
    """What one force adds to the sum, by component; ``drag`` if it is one that must not overshoot."""

    name: str
    force: Sequence[Array]
    drag: Flow | None


@dataclasses.dataclass(frozen=True)
class Equation:
    """dp/dt = v, dv/dt = sum of forces / m, for one number of particles.

    In a run by an explicit first-order step, which overshoots where dt is long against drag, the sum of forces acts on
    a greater mass, see `jeuler.forces.drag.inertia`.
    """

    forces: tuple[Prepared, ...]
    effects: tuple[Any, ...]
    context: Context

    @classmethod
    def of(cls, forces: Iterable[Any], effects: Iterable[Any], context: Context) -> Equation:
        forces, prepared = tuple(forces), []
        limited = context.step is not None and is_explicit_of_first_order(context.step)
        context = dataclasses.replace(context, limits_drag=limited and any(hasattr(f, "drag") for f in forces))
        for k, force in enumerate(forces):
            kernel = force.prepare(context) if hasattr(force, "prepare") else force
            if kernel is not None:
                prepared.append(Prepared(f"forces[{k}] {name_of(force)}", declared(force, "reads"), kernel))
        prepared.sort(key=lambda force: hasattr(force.kernel, "drag"))  # drags last: so they are summed in every run
        prescribing = tuple(effect for effect in effects if hasattr(effect, "prescribe"))
        return cls(tuple(prepared), prescribing, context)

    def vector_field(self, t: Any, y: tuple[Array, Array], args: Any) -> tuple[Array, Array]:
        """The slope (velocity, acceleration) of (position, velocity), m/s and m/s^2."""
        attributes, x, v = self.moving(t, y, args)
        acceleration = self.acceleration(t, x, v, attributes)
        if attributes.alive is not None:
            acceleration = [jnp.where(attributes.alive, one, 0) for one in acceleration]
        slope = stack(v), stack(acceleration)
        for indices, _, velocity, rate in self.prescribed(t, slope[0].dtype):
            slope = slope[0].at[indices].set(velocity), slope[1].at[indices].set(rate)
        return slope

    def moving(self, t: Any, y: tuple[Array, Array], args: Any) -> tuple[Attributes, Any, Any]:
        """Attributes, position and velocity by component; pinned particles at rest, prescribed ones on their path."""
        position, velocity = y
        attributes = args if isinstance(args, Attributes) else Attributes(args)
        mass = jnp.asarray(attributes.mass, dtype=position.dtype)
        velocity = by_component(lambda v: jnp.where(jnp.isinf(mass), 0, v), velocity)
        position, velocity = self.constrain(t, position, velocity)
        return Attributes(mass, attributes.alive, attributes.others), split(position), split(velocity)

    def prescribed(self, t: Any, dtype: Any) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Indices, position, velocity and acceleration of what each effect prescribes."""
        for effect in self.effects:
            indices, *values = effect.prescribe(t, dtype)
            yield jnp.asarray(indices, int), *values

    def constrain(self, t: Any, position: Array, velocity: Array) -> tuple[Array, Array]:
        """Position and velocity at time t with the prescribed ones put in."""
        for indices, p, v, _ in self.prescribed(t, position.dtype):
            position, velocity = position.at[indices].set(p), velocity.at[indices].set(v)
        return position, velocity

    def shares(self, t: Any, x: Any, v: Any, attributes: Attributes) -> Iterator[Share]:
        """What each force adds to the sum. Each gets arrays of its own: so derivatives too are summed by component."""
        mass = jnp.broadcast_to(attributes.mass, x[0].shape) if x else attributes.mass
        context = dataclasses.replace(self.context, alive=attributes.alive)
        for name, reads, kernel in self.forces:
            if attributes.alive is not None and hasattr(kernel, "prepare"):
                kernel = kernel.prepare(context)
                if kernel is None:
                    continue
            if self.context.limits_drag and hasattr(kernel, "drag"):
                drag = kernel.drag(t, stack(x)).through(v)
                yield Share(name, drag.force(), drag)
            else:
                fields = {field: attributes.field(field, name) for field in reads}
                position = stack(x)
                force = checked_force(name, kernel(t, position, stack(v), mass, **fields), position.shape)
                yield Share(name, split(force), None)

    def acceleration(self, t: Any, x: Any, v: Any, attributes: Attributes) -> list[Array]:
        """The sum of forces over the mass, or over that with which no drag overshoots, by component."""
        shares = list(self.shares(t, x, v, attributes))
        drags = [share.drag for share in shares if share.drag is not None]
        others = add([share.force for share in shares if share.drag is None], x)
        if not drags:
            return [force / attributes.mass for force in others]
        if any(drag.speed is not None for drag in drags):
            # each component needs the forces on all: without this, XLA works these out again for each
            others = [once(component) for component in others]
        force = add([others, *(share.force for share in shares if share.drag is not None)], x)
        return limited_acceleration(force, attributes.mass, jnp.asarray(self.context.dt), drags, others)


def checked_force(name: str, force: Any, shape: tuple[int, ...]) -> Array:
    """What a force returned, if it is one force a particle."""
    came = getattr(force, "shape", None)
    if came != shape:
        hint = "write jnp.broadcast_to(force, position.shape) for the same force on all"
        if came == shape[:1]:
            hint = "a number for each particle is no vector, write force[:, None] * direction"
        raise ValueError(
            f"{name} must return the force on each particle, (particle, dim) = {shape}, "
            f"got {'shape ' + str(came) if came is not None else checks.shown(force)}; {hint}"
        )
    return force


def add(forces: Sequence[Sequence[Array]], like: Sequence[Array]) -> list[Array]:
    """The sum of forces given by component; zeros where there is none."""
    if not forces:
        return [jnp.zeros_like(one) for one in like]
    return [total(parts) for parts in zip(*forces, strict=True)]
