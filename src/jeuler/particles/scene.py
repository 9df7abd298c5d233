"""The scene of forces and effects that moves particles, and the run."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks, trees
from jeuler._core.components import by_component, split, stack
from jeuler.forces.fields import per_particle
from jeuler.particles.fields import completed, declared, name_of
from jeuler.particles.state import ParticleState, parked
from jeuler.particles.windows import in_windows
from jeuler.solving._scan import Checkpoint, Grid, Solution, advance_by, check_step, march, no_loss, solve_reversibly
from jeuler.steps.explicit import Step, euler_step


@trees.component()
class Scene:
    """The forces and effects that a system has: what is not listed is not in the traced program.

        dp/dt = v,   dv/dt = sum of forces / m

    A pytree whose leaves are all floating arrays, so ``jax.grad`` with respect to a whole scene works.

    Args:
      forces: functions ``(t, position, velocity, mass) -> (particle, dim)`` in N, such as `Springs` and `Gravity`.
      effects: functions ``(t, dt, state, key) -> state``, applied at each step in this order: births and deaths
        (`Emitter`, `Lifetime`, ...) before the motion, all others, such as `PrescribedMotion`, after it. One that needs
        the state before the motion, such as `Collisions`, has a method ``over_step(t, dt, previous, state, key)``,
        which is called instead.
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
            for part in parts:
                _check_part(name, part)
            object.__setattr__(self, name, tuple(trees.as_component(part) for part in parts))

    def vector_field(self, t: Any, y: tuple[Array, Array], mass: Any) -> tuple[Array, Array]:
        """The equation of motion, as `solve` and ``diffrax.ODETerm`` take it.

            (position, velocity) -> (velocity, acceleration)

        Args:
          t: time, s.
          y: the pair (position, velocity), each (particle, dim), m and m/s.
          mass: () or (particle,), kg; a particle of mass inf does not move. Where forces read further fields of
            the state, what `Scene.attributes` makes of it.
        Returns: the pair (velocity, acceleration), m/s and m/s^2.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> scene = jeuler.Scene(forces=(jeuler.Gravity([-9.5]),))
          >>> velocity, acceleration = scene.vector_field(0.0, (jnp.zeros((1, 1)), jnp.ones((1, 1))), 2.0)
          >>> velocity.tolist(), acceleration.tolist()
          ([[1.0]], [[-9.5]])
        """
        position, velocity = y
        fields = mass if isinstance(mass, dict) else {"mass": mass}
        mass, alive = jnp.asarray(fields["mass"], dtype=position.dtype), fields.get("alive")
        velocity = by_component(lambda v: jnp.where(jnp.isinf(mass), 0, v), velocity)
        position, velocity = self.constrain(t, position, velocity)
        x, v = split(position), split(velocity)
        force = [jnp.zeros_like(component) for component in x]
        for part in self.forces:  # each gets arrays of its own, so that derivatives too are summed by component
            if alive is not None and hasattr(part, "among"):
                part = part.among(alive)
            own = {name: fields[name] for name in declared(part, "reads")}
            share = split(part(t, stack(x), stack(v), mass, **own))
            force = [a + b for a, b in zip(force, share, strict=True)]
        acceleration = [f / mass if alive is None else jnp.where(alive, f / mass, 0) for f in force]
        slope = stack(v), stack(acceleration)
        for effect in self.effects:
            if hasattr(effect, "constrain_slope"):
                slope = effect.constrain_slope(t, *slope)
        return slope

    def prepare(self, particles: int, dtype: Any) -> Scene:
        """The same scene with the work done that is the same at every step."""
        forces = (part.prepare(particles, dtype) if hasattr(part, "prepare") else part for part in self.forces)
        return trees.replace(self, forces=tuple(forces))

    def attributes(self, state: ParticleState) -> Any:
        """What `vector_field` takes beside t and y: the mass, and with it only those fields that some force reads.

        A dead slot has infinite mass there: it feels no force.
        """
        names = {name for part in self.forces for name in declared(part, "reads")}
        mass = state.mass
        if state.alive is not None:
            names.add("alive")
            mass = jnp.where(state.alive, mass, jnp.inf)
        return {"mass": mass, **{name: getattr(state, name) for name in sorted(names)}} if names else mass

    def for_step(self, dt: Any) -> Scene:
        """The scene with drags that never overshoot the air in steps of dt; several share the way to go."""
        drags = sum(hasattr(part, "for_step") for part in self.forces)
        forces = (part.for_step(drags * dt) if hasattr(part, "for_step") else part for part in self.forces)
        return trees.replace(self, forces=tuple(forces)) if drags else self

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
    windows: tuple[int, ...] | str = (),
) -> Solution:
    """Run a scene: num_steps steps of its equation of motion and its effects, in one ``lax.scan``.

        (p, v)_{n+1} = effects(step(scene.vector_field, t_n, (p, v)_n, dt, mass))

    With the default `euler_step` the position moves with the OLD velocity. Births and deaths come before the motion,
    all other effects after it: births, attributes, deaths, motion, appearance.

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
      checkpoint: memory of reverse mode, as in `solve`; "reversible" for scenes of forces alone.
      compensated: compensated sums of position and velocity, as in `solve`.
      windows: sizes in increasing order, or "auto" for a ladder of them. Between two saved states the run works on
        the smallest of these many first slots that holds all that live or can be born, so that a large pool costs
        what is alive. Each size is compiled. Under ``vmap`` all sizes run: leave it empty there.
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
    checks.kind("scene", scene, Scene)
    checks.kind("state", state, ParticleState)
    checks.random_key(key)
    check_step(step)
    state.check()
    state = completed(state, scene.forces, scene.effects)
    scene.check(state)
    grid = Grid.checked(dt, num_steps, t0, save_every, checkpoint, dtype=trees.time_dtype(state.position))
    scene = scene.for_step(grid.dt)
    state = _at_start(scene, state, grid.t0)
    motion = checks.state("state", (state.position, state.velocity))
    form = jax.eval_shape(scene.vector_field, grid.t0, motion, scene.attributes(state))
    checks.same_form("the sum of forces", motion, form)
    _check_effects(scene, state, grid, key)
    advance = advance_by(step if hasattr(step, "increment") else _on_arrays(step), compensated=compensated)
    # each window would need springs laid out for its own size
    prepared = scene if windows else scene.prepare(len(state.position), motion[0].dtype)
    early = any(declared(effect, "before_motion", False) for effect in scene.effects)

    def field(t, motion, attributes):  # on components, as they are carried from step to step
        position, velocity = map(stack, motion)
        return tuple(map(split, prepared.vector_field(t, (position, velocity), attributes)))

    def apply(n, t, previous, state, *, before_motion):
        for index, effect in enumerate(scene.effects):
            if declared(effect, "before_motion", False) == before_motion:
                own_key = None if key is None else jax.random.fold_in(jax.random.fold_in(key, n), index)
                if hasattr(effect, "over_step"):
                    state = effect.over_step(t, grid.dt, previous, state, own_key)
                else:
                    state = effect(t, grid.dt, state, own_key)
        return state

    def next_state(n, t, parts_and_lost):
        parts, lost = parts_and_lost
        previous = joined(parts)
        if early:
            previous = apply(n, t, previous, previous, before_motion=True)
        motion, rest = parted(previous) if early else parts
        motion, lost = advance(field, t, (motion, lost), grid.dt, scene.attributes(previous))
        if not scene.effects:
            return (motion, rest), lost
        state = apply(n, grid.clock(n + 1), previous, joined((motion, rest)), before_motion=False)
        return parted(state if state.alive is None else parked(state)), lost

    def saved(t, parts):
        state = joined(parts)
        return state if save is None else save(t, state)

    if checkpoint == "reversible":
        return _reversibly(prepared, state, field, grid, saved, step, compensated)
    start = parted(state), no_loss(parted(state)[0], compensated)
    within = in_windows(windows, scene, state, save_every)
    return march(next_state, start, grid, saved, watch=lambda parts: parts[0], within=within)


def _reversibly(
    scene: Scene, state: ParticleState, field: Any, grid: Grid, saved: Any, step: Step, compensated: bool
) -> Solution:
    """`simulate` with ``checkpoint="reversible"``: forces alone, on particles that all live."""
    if scene.effects or state.alive is not None:
        what = name_of(scene.effects[0]) if scene.effects else "a pool (alive)"
        raise ValueError(f'checkpoint="reversible" cannot undo effects or births, got {what}; pass checkpoint="sqrt"')
    motion, rest = parted(state)
    attributes = scene.attributes(state)
    return solve_reversibly(
        field, motion, attributes, grid, lambda t, motion: saved(t, (motion, rest)), step, compensated
    )


def _on_arrays(step: Step) -> Step:
    """A step of somebody's own, which may do arithmetic on (particle, dim) arrays, for the motion by components."""

    def by_components(f, t, motion, dt, attributes):
        def on_arrays(t, y, attributes):
            return tuple(map(stack, f(t, tuple(map(split, y)), attributes)))

        return tuple(map(split, step(on_arrays, t, tuple(map(stack, motion)), dt, attributes)))

    return functools.wraps(step)(by_components)


def parted(state: ParticleState) -> tuple[tuple, ParticleState]:
    """A state as it is carried from step to step: the motion by components, and the rest."""
    motion = split(state.position), split(state.velocity)
    return motion, trees.replace(state, position=None, velocity=None)


def joined(parts: tuple[tuple, ParticleState]) -> ParticleState:
    """The state of these parts."""
    (position, velocity), rest = parts
    return trees.replace(rest, position=stack(position), velocity=stack(velocity))


def _check_part(name: str, part: Any) -> None:
    """One ValueError if this cannot be one of Scene.forces or Scene.effects; which it is, its arguments say."""
    expected = f"Scene.{name} must hold functions such as Gravity(...) or Lifetime(...)"
    checks.made(expected, part)
    if not callable(part):
        raise ValueError(f"{expected}, got {part!r}")
    signature = checks.signature_of(part)
    arguments = set(signature.parameters) if signature else set()
    if name == "forces" and {"dt", "state"} <= arguments:
        raise ValueError(f"{name_of(part)} is an effect, (t, dt, state, key) -> state; put it in Scene.effects")
    if name == "effects" and {"position", "velocity"} <= arguments:
        raise ValueError(f"{name_of(part)} is a force, (t, position, velocity, mass) -> N; put it in Scene.forces")


def _check_effects(scene: Scene, state: ParticleState, grid: Grid, key: Array | None) -> None:
    """One ValueError if an effect draws random numbers without a key, or returns a state of another form."""
    for effect in scene.effects:
        if key is None and declared(effect, "random", False):
            raise ValueError(
                f"simulate needs a key, because {name_of(effect)} draws random numbers; pass key=jax.random.key(0)"
            )
        after = jax.eval_shape(effect, grid.t0, grid.dt, state, key)
        if not isinstance(after, ParticleState):
            raise ValueError(f"{name_of(effect)} must return the state, a ParticleState, got {type(after).__name__}")
        added = set(after.fields()) ^ set(state.fields())
        if added:
            raise ValueError(
                f"{name_of(effect)} must return the fields that it got, but {', '.join(sorted(added))} came or went; "
                f'declare what it writes, @jeuler.uses(writes=("{min(added)}",))'
            )
        checks.same_form(name_of(effect), state, after)


def _at_start(scene: Scene, state: ParticleState, t0: Array) -> ParticleState:
    """The state as the run begins with it: pinned particles at rest, prescribed ones on their path."""
    dtype = state.position.dtype
    mass = jax.lax.convert_element_type(state.mass, dtype)
    position = jax.lax.convert_element_type(state.position, dtype)
    velocity = jnp.where(per_particle(jnp.isinf(mass)), 0, jax.lax.convert_element_type(state.velocity, dtype))
    position, velocity = scene.constrain(t0, position, velocity)
    state = trees.replace(state, position=position, velocity=velocity, mass=mass)
    for effect in scene.effects:
        if hasattr(effect, "at_start"):
            state = effect.at_start(t0, state)
    return state if state.alive is None else parked(state)
