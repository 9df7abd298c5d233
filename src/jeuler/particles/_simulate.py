"""The run of a scene: its steps in one scan."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks, trees
from jeuler._core.component import replace
from jeuler._core.components import per_particle, split, stack
from jeuler.particles.fields import declared, name_of, with_required_fields
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, join_state, split_state, zero_dead_slots
from jeuler.particles.windows import in_windows
from jeuler.solving._scan import (
    Checkpoint,
    Grid,
    Solution,
    advance_by,
    check_step,
    no_remainder,
    scan_grid,
    solve_reversibly,
)
from jeuler.steps.explicit import Step, euler_step


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
    state = with_required_fields(state, scene.forces, scene.effects)
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
        previous = join_state(parts)
        if early:
            previous = apply(n, t, previous, previous, before_motion=True)
        motion, rest = split_state(previous) if early else parts
        motion, lost = advance(field, t, (motion, lost), grid.dt, scene.attributes(previous))
        if not scene.effects:
            return (motion, rest), lost
        state = apply(n, grid.clock(n + 1), previous, join_state((motion, rest)), before_motion=False)
        return split_state(state if state.alive is None else zero_dead_slots(state)), lost

    def saved(t, parts):
        state = join_state(parts)
        return state if save is None else save(t, state)

    if checkpoint == "reversible":
        return _reversibly(prepared, state, field, grid, saved, step, compensated)
    start = split_state(state), no_remainder(split_state(state)[0], compensated)
    within = in_windows(windows, scene, state, save_every)
    return scan_grid(next_state, start, grid, saved, watch=lambda parts: parts[0], within=within)


def _reversibly(
    scene: Scene, state: ParticleState, field: Any, grid: Grid, saved: Any, step: Step, compensated: bool
) -> Solution:
    """`simulate` with ``checkpoint="reversible"``: forces alone, on particles that all live."""
    if scene.effects or state.alive is not None:
        what = name_of(scene.effects[0]) if scene.effects else "a pool (alive)"
        raise ValueError(f'checkpoint="reversible" cannot undo effects or births, got {what}; pass checkpoint="sqrt"')
    motion, rest = split_state(state)
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
    state = replace(state, position=position, velocity=velocity, mass=mass)
    for effect in scene.effects:
        if hasattr(effect, "at_start"):
            state = effect.at_start(t0, state)
    return state if state.alive is None else zero_dead_slots(state)
