"""Particles: their state, the scene of forces and effects that moves them, and the run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler import _check, _tree
from jeuler._components import by_component, split, stack
from jeuler.forces.fields import per_particle
from jeuler.methods import Step, euler_step
from jeuler.solve import Checkpoint, Grid, Solution, advance_by, march, no_loss


@_tree.component()
class ParticleState:
    """What the particles of a system are at one time.

    Args:
      position: (particle, dim), m.
      velocity: (particle, dim), m/s.
      mass: () or (particle,), kg; ``inf`` pins a particle where it is.
    Raises: nothing; `simulate` checks it.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState(jnp.zeros((3, 2)), jnp.zeros((3, 2)), mass=[jnp.inf, 1.0, 1.0])
      >>> state.position.shape, state.mass.tolist()
      ((3, 2), [inf, 1.0, 1.0])
    Source: A. Witkin, Particle System Dynamics, SIGGRAPH course notes, 1997, sect. 2.
    """

    position: Array
    velocity: Array
    mass: Array = 1.0  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None and not isinstance(value, jax.Array):
                object.__setattr__(self, field.name, jnp.asarray(value))
        if isinstance(self.mass, jax.Array) and jnp.issubdtype(self.mass.dtype, jnp.integer):
            _tree.store_as_float(self, "mass")

    def check(self) -> None:
        """Shapes, dtypes and masses that a run can use; one ValueError that says which cannot."""
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
        if self.mass.shape not in ((), shape[:1]):
            raise ValueError(f"state.mass must have shape () or {shape[:1]}, one a particle, got {self.mass.shape}")
        if not _check.is_traced(self.mass):
            mass = np.asarray(self.mass).ravel()
            bad = np.flatnonzero(~(mass > 0))
            if bad.size:
                raise ValueError(
                    f"state.mass must be greater than 0 kg (inf pins a particle), got {mass[bad[0]]} at particle {bad[0]}"
                )


@_tree.component()
class Scene:
    """The forces and effects that a system has: what is not listed is not in the traced program.

        dp/dt = v,   dv/dt = sum of forces / m

    A pytree whose leaves are all floating arrays, so ``jax.grad`` with respect to a whole scene works.

    Args:
      forces: functions ``(t, position, velocity, mass) -> (particle, dim)`` in N, such as `Springs` and `Gravity`.
      effects: functions ``(t, dt, state, key) -> state``, applied after each step in this order, such as
        `PrescribedMotion`.
    Raises: ValueError, in `simulate`, where a force or effect does not fit the state.
    Example:
      >>> import jax, jeuler
      >>> scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks=10.0, kd=0.1, rest_length=1.0),))
      >>> jax.tree.map(lambda leaf: 2 * leaf, scene).forces[0].ks.item()
      20.0
    Source: A. Witkin, Particle System Dynamics, SIGGRAPH course notes, 1997, sect. 3.
    """

    forces: tuple = ()
    effects: tuple = ()

    def __post_init__(self) -> None:
        for name in ("forces", "effects"):
            parts = getattr(self, name)
            if not isinstance(parts, (tuple, list)):
                raise ValueError(f"Scene.{name} must be a tuple, got {type(parts).__name__}; write ({name[:-1]},)")
            object.__setattr__(self, name, tuple(_tree.as_component(part) for part in parts))

    def vector_field(self, t: Any, y: tuple[Array, Array], mass: Any) -> tuple[Array, Array]:
        """The equation of motion, as `solve` and ``diffrax.ODETerm`` take it.

            (position, velocity) -> (velocity, acceleration)

        Args:
          t: time, s.
          y: the pair (position, velocity), each (particle, dim), m and m/s.
          mass: () or (particle,), kg; a particle of mass inf does not move.
        Returns: the pair (velocity, acceleration), m/s and m/s^2.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> scene = jeuler.Scene(forces=(jeuler.Gravity([-9.5]),))
          >>> velocity, acceleration = scene.vector_field(0.0, (jnp.zeros((1, 1)), jnp.ones((1, 1))), 2.0)
          >>> velocity.tolist(), acceleration.tolist()
          ([[1.0]], [[-9.5]])
        """
        position, velocity = y
        mass = jnp.asarray(mass, dtype=position.dtype)
        velocity = by_component(lambda v: jnp.where(jnp.isinf(mass), 0, v), velocity)
        position, velocity = self.constrain(t, position, velocity)
        x, v = split(position), split(velocity)
        force = [jnp.zeros_like(component) for component in x]
        for part in self.forces:  # each gets arrays of its own, so that derivatives too are summed by component
            share = split(part(t, stack(x), stack(v), mass))
            force = [a + b for a, b in zip(force, share, strict=True)]
        slope = stack(v), stack([f / mass for f in force])
        for effect in self.effects:
            if hasattr(effect, "constrain_slope"):
                slope = effect.constrain_slope(t, *slope)
        return slope

    def prepare(self, particles: int, dtype: Any) -> Scene:
        """The same scene with the work done that is the same at every step."""
        forces = (part.prepare(particles, dtype) if hasattr(part, "prepare") else part for part in self.forces)
        return dataclasses.replace(self, forces=tuple(forces))

    def constrain(self, t: Any, position: Array, velocity: Array) -> tuple[Array, Array]:
        """Position and velocity at time t with the prescribed ones put in."""
        for effect in self.effects:
            if hasattr(effect, "constrain"):
                position, velocity = effect.constrain(t, position, velocity)
        return position, velocity

    def energy(self, t: Any, y: tuple[Array, Array], mass: Any) -> Array:
        """Kinetic and potential energy of the particles that can move, J; of the forces that have a potential.

            E = sum_i m_i |v_i|^2 / 2 + sum of the forces' energies
        """
        position, velocity = y
        mass = jnp.broadcast_to(jnp.asarray(mass, dtype=position.dtype), position.shape[:1])
        moving = jnp.isfinite(mass)
        kinetic = jnp.sum(jnp.where(moving, mass, 0) * jnp.sum(velocity**2, axis=-1)) / 2
        return kinetic + sum(part.energy(t, position, mass) for part in self.forces if hasattr(part, "energy"))

    def check(self, state: ParticleState) -> None:
        """One ValueError that says which force or effect does not fit the state."""
        for part in (*self.forces, *self.effects):
            if hasattr(part, "check"):
                part.check(*state.position.shape)


def simulate(
    scene: Scene,
    state: ParticleState,
    *,
    dt: Any,
    num_steps: int,
    t0: Any = 0.0,
    step: Step = euler_step,
    save_every: int = 1,
    save: Callable[[Array, ParticleState], Any] | None = None,
    key: Array | None = None,
    checkpoint: Checkpoint = None,
    compensated: bool = False,
) -> Solution:
    """Run a scene: num_steps steps of its equation of motion, its effects after each, in one ``lax.scan``.

        (p, v)_{n+1} = effects(step(scene.vector_field, t_n, (p, v)_n, dt, mass))

    With the default `euler_step` the position moves with the OLD velocity.

    Args:
      scene: forces and effects. Differentiable.
      state: initial state of the particles. Differentiable. A pinned particle's velocity counts as zero.
      dt: step size, > 0, s. Differentiable.
      num_steps: number of steps, an integer >= 0.
      t0: initial time, s.
      step: the method, as in `solve`.
      save_every: save each save_every-th step; must divide num_steps.
      save: ``save(t, state)`` makes what is kept of a saved state; None keeps the state.
      key: a ``jax.random.key`` for effects that draw random numbers; each gets its own at each step.
      checkpoint: memory of reverse mode, as in `solve`.
      compensated: compensated sums of position and velocity, as in `solve`.
    Returns: `Solution` whose ``.y`` is a `ParticleState` with leading axis saved, or what ``save`` returned.
    Raises: ValueError, before tracing, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene(forces=(jeuler.Gravity([0.0, -10.0]),))
      >>> state = jeuler.ParticleState(jnp.zeros((1, 2)), jnp.array([[1.0, 0.0]]))
      >>> jeuler.simulate(scene, state, dt=0.5, num_steps=2).y.position[:, 0].tolist()
      [[0.0, 0.0], [0.5, 0.0], [1.0, -2.5]]
    Source: W. T. Reeves, Particle Systems: A Technique for Modeling a Class of Fuzzy Objects, 1983.
    """
    state.check()
    scene.check(state)
    grid = Grid.checked(dt, num_steps, t0, save_every, checkpoint, dtype=_tree.time_dtype(state.position))
    state = _at_start(scene, state, grid.t0)
    motion = _check.state("state", (state.position, state.velocity))
    _check.same_form("the sum of forces", motion, jax.eval_shape(scene.vector_field, grid.t0, motion, state.mass))
    prepared = scene.prepare(len(motion[0]), motion[0].dtype)
    advance = advance_by(step, compensated=compensated)

    def field(t, motion, mass):  # on components, as they are carried from step to step
        position, velocity = map(stack, motion)
        return tuple(map(split, prepared.vector_field(t, (position, velocity), mass)))

    def next_state(n, t, state_and_lost):
        (motion, state), lost = state_and_lost
        motion, lost = advance(field, t, (motion, lost), grid.dt, state.mass)
        if not scene.effects:
            return (motion, state), lost
        state = joined((motion, state))
        for index, effect in enumerate(scene.effects):
            own_key = None if key is None else jax.random.fold_in(jax.random.fold_in(key, n), index)
            state = effect(grid.clock(n + 1), grid.dt, state, own_key)
        return parted(state), lost

    def saved(t, parts):
        state = joined(parts)
        return state if save is None else save(t, state)

    start = parted(state), no_loss(parted(state)[0], compensated)
    return march(next_state, start, grid, saved, watch=lambda parts: parts[0])


def parted(state: ParticleState) -> tuple[tuple, ParticleState]:
    """A state as it is carried from step to step: the motion by components, and the rest."""
    motion = split(state.position), split(state.velocity)
    return motion, dataclasses.replace(state, position=None, velocity=None)


def joined(parts: tuple[tuple, ParticleState]) -> ParticleState:
    """The state of these parts."""
    (position, velocity), rest = parts
    return dataclasses.replace(rest, position=stack(position), velocity=stack(velocity))


def _at_start(scene: Scene, state: ParticleState, t0: Array) -> ParticleState:
    """The state as the run begins with it: pinned particles at rest, prescribed ones on their path."""
    dtype = state.position.dtype
    mass = jax.lax.convert_element_type(state.mass, dtype)
    position = jax.lax.convert_element_type(state.position, dtype)
    velocity = jnp.where(per_particle(jnp.isinf(mass)), 0, jax.lax.convert_element_type(state.velocity, dtype))
    position, velocity = scene.constrain(t0, position, velocity)
    return dataclasses.replace(state, position=position, velocity=velocity, mass=mass)
