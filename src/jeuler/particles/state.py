"""What the particles are at one time: position, velocity, mass, and only those other fields that a scene uses."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, default
from jeuler._core.arguments import near_name, says_what_to_write
from jeuler._core.component import component, from_numpy, replace, store_as_float
from jeuler._core.components import by_component, split, stack

# What a particle has in a field that nothing gave a value: (shape of one particle's value, value).
DEFAULTS: dict[str, tuple[tuple[int, ...], Any]] = {
    "alive": ((), True),
    "age": ((), 0.0),
    "lifetime": ((), jnp.inf),
    "color": ((3,), 0.2),
    "opacity": ((), 1.0),
    "size": ((), 1.0),
    "shape": ((), 0),
    "frames": ((), 0),
}


class FieldForm(NamedTuple):
    """A field of the user's own, or of an effect: shape, and value (of its type) where nothing gave one.

    The shape is that of one particle's value, or of the field if it is ``whole``: one for the system. "dim" in it is
    the dimension of space.
    """

    shape: tuple[Any, ...]
    value: Any
    whole: bool = False


COUNTERS = ("births", "missed_births")  # one number for the whole pool, int32


@component()
class ParticleState:
    """What the particles of a system are at one time.

    Position, velocity and mass are always there. Every other field is None, and costs nothing, unless the scene or
    the user sets it. `simulate` adds the fields that the effects of its scene write.

    Args:
      position: (particle, dim), m.
      velocity: (particle, dim), m/s.
      mass: () or (particle,), kg; ``inf`` pins a particle where it is.
      alive: (particle,), boolean; None means that all are. A dead slot holds zeros in the other fields.
      age: (particle,), s, since birth.
      lifetime: (particle,), s, the age at which a particle dies.
      color: (particle, 3), red, green, blue from 0 to 1.
      opacity: (particle,), from 0 (invisible) to 1.
      size: (particle,), m, the diameter that is drawn.
      shape: (particle,), integer, the marker that is drawn: 0 circle, 1 square, 2 triangle, 3 diamond, 4 star.
      births: () int32, the number of particles born since the start; it stays at 2^31 - 1.
      missed_births: () int32, the births that found no free slot, likewise.
      unresolved_contacts: () int32, impacts and overlaps that `Collisions` did not resolve.
      steps: () uint32, the steps taken since the start, where random numbers or births hang on it: a run from a saved
        state goes on with those of the run that it was saved from.
      frames: (particle,) int32, the steps that a particle has lived, where `Lifetime` counts them.
      force: (particle, dim), N, what acted on each particle in the last step, where a user asks for it, see `simulate`.
      extra: further fields by name, each (particle, ...), or () or (1, ...) for one of the system: a temperature, a
        team. Read as ``state.temperature``.
    Raises: ValueError, if a field is not an array of numbers; `simulate` checks the shapes.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState(jnp.zeros((3, 2)), jnp.zeros((3, 2)), mass=[jnp.inf, 1.0, 1.0])
      >>> state.position.shape, state.mass.tolist(), state.color
      ((3, 2), [inf, 1.0, 1.0], None)
      >>> state.replace(temperature=jnp.array([20.0, 30.0, 40.0])).temperature.tolist()
      [20.0, 30.0, 40.0]
    """

    position: Parameter
    velocity: Parameter
    mass: Parameter = default(1.0)
    alive: OptionalParameter = default(None)
    age: OptionalParameter = default(None)
    lifetime: OptionalParameter = default(None)
    color: OptionalParameter = default(None)
    opacity: OptionalParameter = default(None)
    size: OptionalParameter = default(None)
    shape: OptionalParameter = default(None)
    births: OptionalParameter = default(None)
    missed_births: OptionalParameter = default(None)
    unresolved_contacts: OptionalParameter = default(None)
    steps: OptionalParameter = default(None)
    frames: OptionalParameter = default(None)
    force: OptionalParameter = default(None)
    extra: dict[str, Array] | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "extra":
                if not isinstance(value, (dict, type(None))):
                    raise ValueError(
                        f"ParticleState.extra must be a dict of arrays by name, got {checks.shown(value)}; "
                        f'write extra={{"temperature": values}}'
                    )
                value = value and {name: _array(f"extra[{name!r}]", x) for name, x in value.items()}
                object.__setattr__(self, "extra", value or None)
            elif value is not None:
                object.__setattr__(self, field.name, _array(field.name, value))
        if isinstance(self.mass, jax.Array) and jnp.issubdtype(self.mass.dtype, jnp.integer):
            store_as_float(self, "mass")

    def __getattr__(self, name: str) -> Any:
        extra = vars(self).get("extra") or {}
        if name in extra:
            return extra[name]
        raise AttributeError(f"the state has no field {name!r}; it has {', '.join(self.fields())}")

    def fields(self) -> tuple[str, ...]:
        """The names of the fields that are there."""
        there = vars(self)  # not getattr: copy and pickle ask an object for attributes before it has any
        own = [name for name in _OWN if there.get(name) is not None]
        return (*own, *(there.get("extra") or {}))

    def replace(self, **values: Any) -> ParticleState:
        """A state with these fields instead; a name that is not a field of its own goes to ``extra``.

        One that is nearly the name of a field is taken for a slip and refused; give such a field with ``extra={...}``.
        """
        own = {f.name for f in dataclasses.fields(self)}
        extra = {name: x for name, x in values.items() if name not in own}
        for name in extra:
            near = None if name in (self.extra or {}) else near_name(name, (*own, *(self.extra or {})), cutoff=0.8)
            if near:
                raise ValueError(
                    f"the state has no field {name!r}; did you mean {near}=...? "
                    f"For a further field of that name write extra={{{name!r}: ...}}"
                )
        if extra:
            values = {name: x for name, x in values.items() if name in own}
            values["extra"] = {**(self.extra or {}), **extra}
        return replace(self, **values)

    def check(self) -> None:
        """Shapes, dtypes and masses that a run can use; one ValueError that says which cannot."""
        for name in ("position", "velocity", "mass"):
            if getattr(self, name) is None:
                raise ValueError(f"state.{name} must be an array of numbers, got None; every particle has one")
        for name in ("position", "velocity"):
            x = getattr(self, name)
            if not jnp.issubdtype(x.dtype, jnp.floating):
                raise ValueError(
                    f"state.{name} must be floating, got {x.dtype}; convert it, jnp.asarray({name}, dtype=float)"
                )
        shape = self.position.shape
        if len(shape) != 2:
            raise ValueError(
                f"state.position must have shape (particle, dim), got {shape}; for a batch of systems use jax.vmap"
            )
        if self.velocity.shape != shape:
            raise ValueError(f"state.velocity must have the shape of position, {shape}, got {self.velocity.shape}")
        if self.velocity.dtype != self.position.dtype:
            raise ValueError(
                f"state.velocity must have the dtype of position, {self.position.dtype}, got {self.velocity.dtype}"
            )
        if not jnp.issubdtype(self.mass.dtype, jnp.floating):
            raise ValueError(f"state.mass must be real numbers in kg, got {self.mass.dtype}; inf pins a particle")
        checks.shape("state.mass", self.mass.shape, (), shape[:1], meaning="one a particle")
        if not checks.is_traced(self.mass):
            mass = np.asarray(self.mass).astype(self.position.dtype).ravel()
            if not np.all(mass > 0):
                bad = np.flatnonzero(~(mass > 0))
                raise ValueError(
                    f"state.mass must be greater than 0 kg (inf pins a particle), got {mass[bad[0]]} "
                    f"at particle {bad[0]}"
                )
        self._check_fields(shape[0])

    def _check_fields(self, particles: int) -> None:
        for name in self.fields():
            shape, dtype = getattr(self, name).shape, getattr(self, name).dtype
            if name in DEFAULTS and isinstance(DEFAULTS[name][1], float) and not jnp.issubdtype(dtype, jnp.floating):
                raise ValueError(f"state.{name} must be floating, got {dtype}; convert it, jnp.asarray(x, dtype=float)")
            if name in DEFAULTS:
                checks.shape(f"state.{name}", shape, (particles, *DEFAULTS[name][0]))
            if name == "force" and (shape, dtype) != (self.position.shape, self.position.dtype):
                raise ValueError(
                    f"state.force must be an array as position, {self.position.dtype} {self.position.shape}, "
                    f"got {dtype} {shape}; write state.replace(force=jnp.zeros_like(state.position))"
                )
            if name in (self.extra or {}) and shape[:1] not in ((), (particles,), (1,)):
                raise ValueError(f"state.{name} must have shape () or ({particles}, ...), one a particle, got {shape}")
        if self.alive is not None and self.alive.dtype != bool:
            raise ValueError(
                f"state.alive must be boolean, got {self.alive.dtype}; write for example alive=(alive > 0)"
            )


_OWN = tuple(field.name for field in dataclasses.fields(ParticleState) if field.name != "extra")


def _array(name: str, value: Any) -> Array:
    """A field as an array of numbers; one ValueError if it is none."""
    if isinstance(value, jax.Array):
        return value
    try:
        if isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
            return from_numpy(value)
        return jax.device_put(value) if type(value) is float else jnp.asarray(value)  # asarray would compile a program
    except (TypeError, ValueError):
        raise ValueError(f"ParticleState.{name} must be an array of numbers, got {checks.shown(value)}") from None


@says_what_to_write()
def empty_pool(capacity: int, dim: int, *, mass: Any = 1.0, dtype: Any = None) -> ParticleState:
    """A pool of free slots, all dead, for an `Emitter` to fill.

    Args:
      capacity: the number of slots, the most particles that can be alive at once, an integer >= 1.
      dim: the dimension of space, 2 or 3 as a rule.
      mass: mass of each particle, () or (capacity,), kg.
      dtype: precision of position and velocity; None means JAX's default float.
    Returns: a `ParticleState` with ``alive`` False everywhere.
    Raises: ValueError, if the capacity or the dimension is not a positive integer, or dtype is not floating.
    Example:
      >>> import jeuler
      >>> pool = jeuler.empty_pool(100, dim=3)
      >>> pool.position.shape, int(pool.alive.sum())
      ((100, 3), 0)
    """
    capacity, dim = checks.count("capacity", capacity, least=1), checks.count("dim", dim, least=1)
    try:
        kind = jnp.dtype(dtype or float)
    except TypeError:
        raise ValueError(f"dtype must be a floating dtype such as jnp.float32, got {checks.shown(dtype)}") from None
    if not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"dtype must be floating, got {kind}; write jnp.float32 or None")
    zeros = jnp.zeros((capacity, dim), dtype or float)
    pool = ParticleState(zeros, zeros, mass=mass, alive=jnp.zeros(capacity, bool))
    pool.check()
    return pool


def with_default_fields(
    state: ParticleState, names: tuple[str, ...], shapes: dict[str, Any] | None = None
) -> ParticleState:
    """The state with default values in those of the named fields that it lacks; mass becomes one a particle.

    ``shapes``: of one particle's value, or a `FieldForm`, for fields that are not the library's own.
    """
    particles, dtype = len(state.position), state.position.dtype
    values: dict[str, Array] = {}
    for name in names:
        if name == "mass":
            values[name] = jnp.broadcast_to(state.mass, (particles,))
        elif name not in state.fields():
            if name in (*COUNTERS, "unresolved_contacts", "steps"):
                values[name] = jnp.uint32(0) if name == "steps" else jnp.int32(0)
            else:
                form = DEFAULTS.get(name, (shapes or {}).get(name, ()))
                shape, value, *whole = form if name in DEFAULTS or isinstance(form, FieldForm) else (form, 0.0)
                shape = tuple(state.position.shape[1] if n == "dim" else n for n in shape)
                kind = {bool: bool, int: jnp.int32}.get(type(value), dtype)
                values[name] = jnp.full(shape if any(whole) else (particles, *shape), value, kind)
    return state.replace(**values) if values else state


def zero_dead_slots(state: ParticleState) -> ParticleState:
    """The state with zeros in the dead slots, whatever an effect left there; masses are kept."""

    def park(x: Array) -> Array:
        if x.shape[:1] != state.position.shape[:1]:
            return x
        return jnp.where(alive.reshape(-1, *(1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    alive = jnp.asarray(state.alive)
    rest = jax.tree.map(park, replace(state, position=None, velocity=None, mass=None))
    position, velocity = (by_component(park, x) for x in (state.position, state.velocity))
    return replace(rest, position=position, velocity=velocity, mass=state.mass)


def in_space(x: np.ndarray) -> np.ndarray:
    """Points (..., dim) with 0 for the coordinates that they do not have: (..., 3)."""
    return np.concatenate([x, np.zeros((*x.shape[:-1], 3 - x.shape[-1]), x.dtype)], axis=-1)


def check_run(caller: str, solution: Any) -> None:
    """An error in the words of ``caller`` unless the solution holds states with leading axis saved."""
    if not isinstance(solution.y, ParticleState) or jnp.ndim(solution.y.position) != 3:
        raise ValueError(
            f"{caller} needs a solution whose .y is a ParticleState with leading axis saved; run simulate with "
            f"save=None, and take one member of a batch"
        )


def split_state(state: ParticleState) -> tuple[tuple[Any, ...], ParticleState]:
    """A state as it is carried from step to step: the motion by components, and the rest."""
    motion = split(state.position), split(state.velocity)
    return motion, replace(state, position=None, velocity=None)


def join_state(parts: tuple[tuple[Any, ...], ParticleState]) -> ParticleState:
    """The state of these parts."""
    (position, velocity), rest = parts
    return replace(rest, position=stack(position), velocity=stack(velocity))
