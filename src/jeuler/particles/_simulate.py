"""The run of a scene: its steps in one scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import Function, replace
from jeuler._core.components import per_particle
from jeuler._core.limits import check_parameters
from jeuler._jax import programs
from jeuler._jax.haste import Haste
from jeuler.contact.collisions import has_long_code
from jeuler.graphs.partition import Partition
from jeuler.particles.divided import check_division
from jeuler.particles.divided_run import divided_loop, run_divided
from jeuler.particles.equation import Equation
from jeuler.particles.fields import START, acts, draws, name_of, needs, with_required_fields
from jeuler.particles.protocols import Context
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState, join_state, split_state, with_default_fields, zero_dead_slots
from jeuler.particles.step import SceneStep, with_its_needs
from jeuler.particles.windows import in_windows
from jeuler.solving._scan import INSTEAD, Solution, check_save, check_step, no_remainder, reversible_loop
from jeuler.solving.chunks import Progress, can_be_in_chunks, check_progress, run_in_chunks
from jeuler.solving.grid import Checkpoint, Grid
from jeuler.solving.long_runs import check_resume, run_on_disk
from jeuler.solving.loop import Loop, in_one_scan
from jeuler.steps.explicit import Step, euler_step

ON_A_SCENE = {"args": "the mass with the state, state.replace(mass=...)", "mass": "state.replace(mass=...)"}


@says_what_to_write(**INSTEAD | ON_A_SCENE)
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
    progress: Progress = None,
    resume: Any = None,
    checkpoint_every: int | None = None,
    mesh: Any = None,
) -> Solution:
    """Run a scene: num_steps steps of its equation of motion and its effects, in one ``lax.scan``.

        (p, v)_{n+1} = effects(step(scene.vector_field, t_n, (p, v)_n, dt, mass))

    With the default `euler_step` the position moves with the OLD velocity. Births and deaths come before the motion,
    all other effects after it: births, attributes, deaths, motion, appearance.

    Args:
      scene: forces and effects. Differentiable.
      state: initial state of the particles. Differentiable. A pinned particle's velocity counts as zero.
      dt: step size, s; negative steps back in time, where no effect forbids it. Differentiable.
      num_steps: number of steps, an integer >= 0.
      t0: initial time, s.
      step: the method, as in `solve`.
      save_every: save each save_every-th step; must divide num_steps.
      save: ``save(t, state)`` makes what is kept of a saved state; None keeps the state.
      key: a ``jax.random.key`` for effects that draw random numbers; each gets its own at each step. A run from a state
        that another saved, with the same key and scene and its time as t0, goes on as that one would have.
      checkpoint: memory of reverse mode, as in `solve`; "reversible" for scenes of forces alone.
      compensated: compensated sums of position and velocity, as in `solve`.
      windows: sizes in increasing order, or "auto" for a ladder of them. Between two saved states the run works on
        the smallest of these many first slots that holds all that live or can be born, so that a large pool costs
        what is alive. Each size is compiled. Under ``vmap`` all sizes run: leave it empty there.
      progress: a bar, or a function to call, as in `solve`.
      resume: path of a folder that keeps the run, as in `solve`.
      checkpoint_every: steps between two states on disk, as in `solve`.
      mesh: a ``jax.sharding.Mesh``: the particles of this one scene are divided over all its devices, which send each
        other the positions and velocities of those at their borders at each evaluation of the forces; `divide` tells
        which scenes can be divided, and what is sent. Explicit steps only; ``save`` is done at the end, on all frames,
        but with ``resume`` or ``progress``.
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
    check_progress(progress, checkpoint)
    check_resume(resume, checkpoint_every, checkpoint)
    check_kinds(scene, state)
    check_parameters("scene", scene)
    grid = check_run(scene, state, dt, num_steps, t0, save_every, key, checkpoint, many=can_be_in_chunks(checkpoint))
    checks.true_or_false("compensated", compensated)
    inputs = scene, state, grid, key, Function(step), Function(save)
    if mesh is not None:
        how = {"windows": windows, "resume": resume, "key": key}
        parts = check_division(scene, state, mesh, step, checkpoint, how)
        divided = scene, state, grid, parts, Function(step), Function(save)
        if resume is None and not progress:
            return programs.call(_simulate_divided, divided, (checkpoint, compensated, mesh))
        way = _loop_on_devices, divided, (compensated, mesh), grid
        if resume is not None:
            return Solution(*run_on_disk(*way, resume, checkpoint_every, progress))
        found = run_in_chunks(*way, progress)
        return Solution(*(in_one_scan(_loop_on_devices(*divided, compensated, mesh)) if found is None else found))
    if not isinstance(windows, (str, tuple, list)):
        came = checks.shown(windows)
        raise ValueError(f'windows must be "auto" or a tuple of sizes, got {came}; write windows=({came},)')
    settings = checkpoint, compensated, windows if isinstance(windows, str) else tuple(windows)
    if checkpoint == "reversible":  # looks at values
        return _simulate(*inputs, *settings)
    if resume is not None:
        return Solution(*run_on_disk(_loop, inputs, settings, grid, resume, checkpoint_every, progress))
    found = run_in_chunks(_loop, inputs, settings, grid, progress)
    return programs.call(_simulate, inputs, settings, _haste(scene, state)) if found is None else Solution(*found)


def _haste(scene: Scene, state: ParticleState) -> Haste:
    """A program of few contacts is small work and long code."""
    return "some" if has_long_code(scene.effects, len(state.position)) else "none"


def _simulate(*given: Any) -> Solution:
    """`simulate`, as it is compiled in one piece."""
    return Solution(*in_one_scan(_loop(*given)))


def _simulate_divided(
    scene: Scene,
    state: ParticleState,
    grid: Grid,
    parts: Partition,
    stepper: Function,
    saver: Function,
    checkpoint: Checkpoint,
    compensated: bool,
    mesh: Any,
) -> Solution:
    """`simulate` over the devices of a mesh."""
    check_save(saver.function)

    def run(scene, state, grid):
        loop = _loop(scene, state, grid, None, stepper, Function(None), checkpoint, compensated, ())
        return in_one_scan(loop)[:3]

    t, y, first_nonfinite = run_divided(run, scene, state, grid, parts, mesh)
    unresolved = jnp.int32(0) if y.unresolved_contacts is None else y.unresolved_contacts[-1]
    if saver.function is not None:
        y = jax.vmap(saver.function)(t, y)
    return Solution(t, y, first_nonfinite, unresolved)


def _loop_on_devices(
    scene: Scene,
    state: ParticleState,
    grid: Grid,
    parts: Partition,
    stepper: Function,
    saver: Function,
    compensated: bool,
    mesh: Any,
) -> Loop:
    """The loop of `simulate` over the devices of a mesh, for a run that is kept or shows how far it is."""
    check_save(saver.function)
    _, state = first_step(scene, state, grid, stepper.function, None)
    return divided_loop(scene, state, grid, parts, mesh, stepper.function, saver.function, compensated)


def _loop(
    scene: Scene,
    state: ParticleState,
    grid: Grid,
    key: Array | None,
    stepper: Function,
    saver: Function,
    checkpoint: Checkpoint,
    compensated: bool,
    windows: tuple[int, ...] | str,
) -> Loop:
    """The loop of `simulate`."""
    step, save = stepper.function, saver.function
    check_save(save)
    scene_step, state = first_step(scene, state, grid, step, key, compensated=compensated, any_window=bool(windows))

    def saved(t, parts):
        state = join_state(parts)
        return state if save is None else save(t, state)

    if checkpoint == "reversible":
        return _reversibly(scene_step, state, saved)
    motion, rest = split_state(state)
    start = (motion, rest), no_remainder(motion, compensated)
    within = in_windows(windows, scene, state, grid.save_every)
    return Loop(
        scene_step,
        start,
        grid,
        saved,
        watch=lambda parts: parts[0],
        within=within,
        unresolved=lambda parts: parts[1].unresolved_contacts,
    )


def check_run(
    scene: Scene,
    state: ParticleState,
    dt: Any,
    num_steps: int,
    t0: Any,
    save_every: int,
    key: Array | None,
    checkpoint: Checkpoint = None,
    many: bool = False,
) -> Grid:
    """Every check that looks at values, of these arguments of `simulate` but for parameters of the scene."""
    check_kinds(scene, state)
    checks.random_key(key)
    state.check()
    scene.check(state)
    dt = forwards(scene, dt)
    return Grid.checked(dt, num_steps, t0, save_every, checkpoint, trees.time_dtype(state.position), many)


def check_kinds(scene: Any, state: Any) -> None:
    """One ValueError if the first two arguments are not a scene and a state."""
    if isinstance(scene, ParticleState) and isinstance(state, Scene):
        raise ValueError("scene comes first, then state, got them swapped; write simulate(scene, state, ...)")
    if not isinstance(scene, Scene):
        hint = "write Scene(forces=(...,), effects=(...,))"
        raise ValueError(f"scene must be a Scene, got {checks.shown(scene)}; {hint}")
    if not isinstance(state, ParticleState):
        hint = "write ParticleState(position, velocity, mass=...)"
        raise ValueError(f"state must be a ParticleState, got {checks.shown(state)}; {hint}")


def forwards(scene: Scene, dt: Any) -> Any:
    """dt, where the scene can run backwards or dt is above 0; else one ValueError, or NaN where dt is traced."""
    one_way = [name_of(effect) for effect in scene.effects if needs(effect, "forward time")]
    if not one_way:
        return dt
    checks.number("dt", dt)
    if checks.is_traced(dt):
        return jnp.where(dt < 0, jnp.nan, dt)
    if float(dt) < 0:
        raise ValueError(
            f"dt must be greater than 0 s with {one_way[0]}, which cannot be undone, got {float(dt):g} s; "
            f"only forces and prescribed motion run backwards in time"
        )
    return dt


def first_step(
    scene: Scene, state: ParticleState, grid: Grid, step: Step, key: Array | None, **how: bool
) -> tuple[SceneStep, ParticleState]:
    """The step and the first state of a run; checked in what does not depend on values."""
    check_step(step)
    state = with_required_fields(state, scene.forces, scene.effects)
    if any(draws(effect, key) or needs(effect, "clock") for effect in scene.effects):
        state = with_default_fields(state, ("steps",))
    state = _at_start(scene, state, grid, key)
    motion = checks.state("state", (state.position, state.velocity))
    form = checks.form_of(
        "the sum of forces", scene.without_effects().vector_field, grid.t0, motion, scene.attributes(state)
    )
    checks.same_form("the sum of forces", motion, form)
    _check_effects(scene, state, grid, key)
    return SceneStep.of(scene, state, grid, step, key, **how), state


def begin(
    scene: Scene,
    state: ParticleState,
    *,
    dt: Any,
    num_steps: int,
    t0: Any = 0.0,
    step: Step = euler_step,
    save_every: int = 1,
    key: Array | None = None,
    checkpoint: Checkpoint = None,
    compensated: bool = False,
) -> tuple[SceneStep, ParticleState]:
    """The step and the first state of a run with these arguments, as `simulate` takes them; checked."""
    grid = check_run(scene, state, dt, num_steps, t0, save_every, key, checkpoint)
    return first_step(scene, state, grid, step, key, compensated=compensated)


def _reversibly(run: SceneStep, state: ParticleState, saved: Any) -> Loop:
    """The loop of `simulate` with ``checkpoint="reversible"``: forces alone, on particles that all live."""
    effects = run.scene.effects
    if effects or state.alive is not None:
        what = name_of(effects[0]) if effects else "a pool (alive)"
        raise ValueError(f'checkpoint="reversible" cannot undo effects or births, got {what}; pass checkpoint="sqrt"')
    motion, rest = split_state(state)
    attributes = run.scene.attributes(state)
    return reversible_loop(
        run.field, motion, attributes, run.grid, lambda t, motion: saved(t, (motion, rest)), run.step, run.compensated
    )


def _check_effects(scene: Scene, state: ParticleState, grid: Grid, key: Array | None) -> None:
    """One ValueError if an effect draws random numbers without a key, or returns a state of another form."""
    for effect in scene.effects:
        if key is None and needs(effect, "key"):
            raise ValueError(
                f"simulate needs a key, because {name_of(effect)} draws random numbers; pass key=jax.random.key(0)"
            )
        act = with_its_needs(effect, key, jnp.int32(0), grid.t0)
        after = checks.form_of(name_of(effect), act, grid.t0, grid.dt, state, state)
        if not isinstance(after, ParticleState):
            raise ValueError(f"{name_of(effect)} must return the state, a ParticleState, got {type(after).__name__}")
        added = set(after.fields()) ^ set(state.fields())
        if added:
            raise ValueError(
                f"{name_of(effect)} must return the fields that it got, but {', '.join(sorted(added))} came or went; "
                f'declare what it writes, @jeuler.uses(writes=("{min(added)}",))'
            )
        checks.same_form(name_of(effect), state, after)


def _at_start(scene: Scene, state: ParticleState, grid: Grid, key: Array | None) -> ParticleState:
    """The state as the run begins with it: pinned particles at rest, prescribed ones on their path."""
    dtype = state.position.dtype
    mass = jax.lax.convert_element_type(state.mass, dtype)
    position = jax.lax.convert_element_type(state.position, dtype)
    velocity = jnp.where(per_particle(jnp.isinf(mass)), 0, jax.lax.convert_element_type(state.velocity, dtype))
    equation = Equation.of((), scene.effects, Context(len(position), dtype))
    position, velocity = equation.constrain(grid.t0, position, velocity)
    state = replace(state, position=position, velocity=velocity, mass=mass)
    for k, effect in enumerate(scene.effects):
        if acts(effect) == START:
            own_key = None if key is None else jax.random.fold_in(jax.random.fold_in(key, 2**32 - 1), k)
            act = with_its_needs(effect, own_key, jnp.int32(0), grid.t0)
            acted = act(grid.t0, jnp.zeros_like(grid.dt), state, state)
            state = acted if not draws(effect, key) else _if_new(acted, state)
    return state if state.alive is None else zero_dead_slots(state)


def _if_new(acted: ParticleState, state: ParticleState) -> ParticleState:
    """What a random effect did at the start, unless the state is of a run that has begun: it was done there."""
    return jax.tree.map(lambda a, b: jnp.where(jnp.asarray(state.steps) == 0, a, b), acted, state)
