"""The one program of a fit of positions against `simulate` differentiated; and how many programs a first fit compiles."""

import jax
import numpy as np
import pytest

import jeuler
from jeuler.fitting.evaluate import residual_and_jacobian
from jeuler.fitting.forward import Forward
from jeuler.fitting.recorded import Recorded

EDGES = np.array([[0, 1], [1, 2], [2, 3], [0, 2]])
ON_THE_GRID, BETWEEN = np.linspace(0.0, 0.6, 13), np.sort(np.append(np.linspace(0.0, 0.59, 9), [0.3, 0.3]))


def recorded(times, step, dtype, effects=(), names=("ks", "kd", "velocity"), dt=0.05):
    random = np.random.default_rng(0)
    x = np.array([[0.0, 0.0], [1.0, 0.1], [2.0, 0.0], [3.0, -0.2]], dtype)
    v, mass = random.normal(size=x.shape).astype(dtype), np.array([np.inf, 1.0, 2.0, 0.5], dtype)
    forces = (jeuler.Springs(EDGES, np.full(4, 30.0, dtype), np.full(4, 0.3, dtype), 1.0), jeuler.Gravity([0.0, -1.0]))
    y = random.normal(size=(len(times), *x.shape))
    y[2, 1], y[:, 3, 0] = np.nan, np.nan
    scene, state = jeuler.Scene(forces, effects), jeuler.ParticleState(x, v, mass)
    return Recorded.of(
        scene, state, times, y, dt=dt, t0=0.0, num_steps=None, step=step, names=names, where=None
    )  # fmt: skip


@pytest.mark.parametrize("times", [ON_THE_GRID, BETWEEN], ids=["on the grid", "between"])
@pytest.mark.parametrize(
    ("step", "dtype"),
    [(jeuler.rk4_step, float), (jeuler.rk4_step, np.float32), (jeuler.symplectic_euler_step, float)],
)
def test_residual_and_jacobian_are_those_of_the_differentiated_run(times, step, dtype):
    others = ("ks", "rest_length", "mass", "position", "anchors")
    task = recorded(times, step, dtype, names=("ks", "kd", "velocity") if times is ON_THE_GRID else others)
    problem = task.problem(task.start, None, None, None, ())
    x = np.asarray(problem.x, float)
    assert len(x) > 8
    expected, slope = jax.jit(lambda x, data: residual_and_jacobian(problem.residual, x, data))(x, task.data)
    r, jacobian = Forward.of(task.prediction, problem.layout, task.data).residual_at(x, task.data)
    close = 1e-10 if dtype is float else 2e-4
    np.testing.assert_allclose(r, expected, atol=close)
    np.testing.assert_allclose(jacobian(), slope, atol=close * np.abs(slope).max())


def test_effects_act_as_in_simulate():
    def drift(t, dt, previous, state, key):
        return state.replace(velocity=0.9 * state.velocity + 0.1 * t)

    task = recorded(BETWEEN, jeuler.rk4_step, float, effects=(drift,))
    problem = task.problem(task.start, None, None, None, ())
    x = np.asarray(problem.x, float)
    forward = Forward.of(task.prediction, problem.layout, task.data)
    run = jeuler.simulate(task.scene, task.state, dt=0.05, num_steps=12, step=jeuler.rk4_step)
    k = np.flatnonzero(BETWEEN == 0.3)[0]
    np.testing.assert_allclose(forward.positions(x, task.data)[k], run.y.position[6], atol=1e-12)


@pytest.mark.parametrize("times", [ON_THE_GRID, BETWEEN], ids=["on the grid", "between"])
def test_the_same_program_runs_at_half_the_step(times):
    whole, half = (recorded(times, jeuler.rk4_step, float, dt=dt) for dt in (0.05, 0.025))
    layout = whole.problem(whole.start, None, None, None, ()).layout
    x = np.asarray(layout.vector(whole.start), float)
    r, _ = Forward.of(whole.prediction, layout, whole.data).residual_at(x, half.data, parts=2)
    np.testing.assert_allclose(r, np.ravel(half.prediction(half.start, half.data)), atol=1e-11)


def test_a_first_fit_compiles_one_program_for_its_runs_and_a_second_none(compiled):
    """With its bias at half the step and its prediction; 20 programs before."""
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=np.array([20.0]), kd=np.array([0.3]), rest_length=1.0),))
    state = jeuler.ParticleState(np.array([[0.0], [1.5]]), np.zeros((2, 1)), np.array([np.inf, 1.0]))
    t = np.linspace(0, 2, 43)
    w = np.sqrt(25.0 - 0.04)  # of ks = 25 N/m and kd = 0.4 N s/m
    x = 1 + 0.5 * np.exp(-0.2 * t) * (np.cos(w * t) + 0.2 / w * np.sin(w * t))
    target = np.stack([0 * t, x + 1e-3 * np.sin(71 * t**2)], axis=1)[..., None]
    found = jeuler.fit_springs(scene, state, t, target, dt=2 / 84, progress=False)
    assert found.converged
    assert found.step_bias is not None
    assert abs(float(found.ks[0]) - 25) < 0.3
    first = len(compiled)
    assert 1 <= first <= 4
    other = jeuler.fit_springs(scene, state, t, target + 1e-3 * np.cos(67 * t**2)[:, None, None], dt=2 / 84)
    assert abs(float(other.ks[0]) - 25) < 0.3
    assert len(compiled) == first
