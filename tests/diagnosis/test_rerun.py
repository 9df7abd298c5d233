"""The step that `diagnose` looks at, part by part, is the step that `simulate` takes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import EFFECTS
from hook_scenes import SCENES
from jax import lax

import jeuler
from jeuler.diagnosis.rerun import Rerun
from jeuler.particles.protocols import HOOKS

NUM_STEPS = 3
TOLERANCE = {"float32": 2e-6, "float64": 1e-12}


def test_the_scenes_have_every_hook_and_every_effect():
    parts = [part for case in SCENES.values() for part in case.components()]
    assert {hook for hook in HOOKS if any(hasattr(part, hook) for part in parts)} == set(HOOKS)
    assert {name for case in SCENES.values() for name in case.builtin} == set(EFFECTS)


@functools.cache
def rerun(name, dtype):
    """A case, its run, and the states that `simulate` saves."""
    case = SCENES[name]
    state = case.state(jnp.dtype(dtype))
    run = Rerun.of(case.scene(), state, NUM_STEPS, dt=0.05, key=jax.random.key(3), step=case.step)
    return case, run, run.solution(NUM_STEPS, save_every=1).y


def at(states, n):
    return jax.tree.map(lambda x: x[n], states)


def end_of_step(run, n, before):
    *_, (_, after) = run.parts_of_step(n, before)
    return after


def same(found, expected, dtype):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


CASES = [(name, dtype) for name in SCENES for dtype in TOLERANCE if (name, dtype) != ("pairs", "float32")]
SLOW_TO_COMPILE = ("contact",)


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_parts_of_each_step_end_in_the_next_state_of_the_run(name, dtype):
    """As `diagnose` calls them, and, in double precision, within one compiled program too."""
    _, run, states = rerun(name, dtype)
    numbers = range(1, NUM_STEPS + 1)
    for n in numbers:
        same(end_of_step(run, n, at(states, n - 1)), at(states, n), dtype)
    if dtype == "float64" and name not in SLOW_TO_COMPILE:
        starts = jnp.array(numbers, jnp.int32), at(states, slice(0, -1))
        within, parts = jax.jit(
            lambda: (run.solution(NUM_STEPS, save_every=1).y, lax.map(lambda s: end_of_step(run, *s), starts))
        )()
        same(within, states, dtype)
        same(parts, at(states, slice(1, None)), dtype)


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_the_named_forces_add_up_to_the_one_that_acted(name, dtype):
    """Under explicit steps of first order it is what changed the velocity, of the greater mass where drag is limited."""
    case, run, states = rerun(name, dtype)
    dt = run.of_one.grid.dt
    for n in range(1, NUM_STEPS + 1):
        start = at(states, n - 1)
        before, t = run.before_motion(n, start), run.time(n)
        shares = dict(run.shares(t, before))
        names = [name for name in shares if "Absent" not in name]
        assert sorted(int(name[7]) for name in names) == [
            k for k, force in enumerate(case.forces) if type(force).__name__ != "Absent"
        ]
        total = sum(shares.values())
        mass = np.broadcast_to(run.scene.attributes(before).mass, 4)
        acted = np.isfinite(mass)
        for indices, *_ in run.of_one.equation.prescribed(t, dtype):
            acted[np.asarray(indices)] = False
        if case.step in (jeuler.euler_step, jeuler.symplectic_euler_step):
            heavy = np.maximum(mass, case.linear * float(dt))
            moved = dict(run.parts_of_step(n, start))[case.step.__name__]
            force = heavy[:, None] * (moved.velocity - before.velocity) / dt
        else:
            y = before.position, before.velocity
            force = mass[:, None] * run.scene.without_effects().vector_field(t, y, run.scene.attributes(before))[1]
        tolerance = 2e-5 if dtype == "float32" else 1e-10
        size = np.abs(total[acted]).max(initial=1.0)
        np.testing.assert_allclose(total[acted], force[acted], rtol=tolerance, atol=tolerance * size)


def test_a_run_in_windows_is_the_same_run():
    """A drag that is limited, and births into a part of the slots."""
    jet = jeuler.Emitter(10.0, [0.5, 2.0], [0.1, 0.3], max_births=1)
    scene = jeuler.Scene((jeuler.Gravity([0.3, -9.81]), jeuler.QuadraticDrag(30.0)), (jet, jeuler.Lifetime(0.3)))
    arguments = {"dt": 0.1, "key": jax.random.key(3)}
    run = Rerun.of(scene, jeuler.empty_pool(8, dim=2), 6, **arguments)
    states = jeuler.simulate(scene, run.given, num_steps=6, windows=(3, 5), **arguments).y
    assert states.births[-1] > 3
    for n in range(1, 7):
        same(end_of_step(run, n, at(states, n - 1)), at(states, n), "float64")
