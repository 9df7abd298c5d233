"""Every step: its numbers, its order, its form."""

import inspect

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import METHODS, PROBLEMS, oscillator, oscillator_exact

import jeuler
from jeuler.steps import explicit


def final_error(step, num_steps):
    args = (4.0, 0.4)
    y = jeuler.solve(oscillator, (1.0, 0.0), dt=3.0 / num_steps, num_steps=num_steps, args=args, step=step).y
    x, v = oscillator_exact(3.0)
    return float(np.hypot(y[0][-1] - x, y[1][-1] - v))


@pytest.mark.parametrize("name", METHODS)
def test_order(name):
    coarse, fine = final_error(METHODS[name].step, 200), final_error(METHODS[name].step, 400)
    assert abs(np.log2(coarse / fine) - METHODS[name].order) < 0.1


@pytest.mark.parametrize("name", METHODS)
def test_signature(name):
    assert list(inspect.signature(METHODS[name].step).parameters) == ["f", "t", "y", "dt", "args"]
    assert METHODS[name].step.order == METHODS[name].order


@pytest.mark.parametrize("tableau", [explicit.HEUN, explicit.RK4])
def test_tableau_is_consistent(tableau):
    assert np.allclose([sum(row) for row in tableau.matrix], tableau.nodes)
    assert np.isclose(sum(tableau.weights), 1)
    assert np.isclose(np.dot(tableau.weights, tableau.nodes), 1 / 2)


def test_source_example_with_step_one():
    y = jeuler.solve(PROBLEMS["source"].f, -3.0, dt=1.0, num_steps=5, args=1.0).y
    np.testing.assert_allclose(y, [-3, -3.6, -3.32, -1.984, 0.6192, 4.7430], atol=5e-5)


def test_source_example_with_step_a_fifth():
    y = jeuler.solve(PROBLEMS["source"].f, -3.0, dt=0.2, num_steps=5, args=1.0).y
    np.testing.assert_allclose(y, [-3, -3.12, -3.205, -3.253, -3.263, -3.234], atol=6e-4)


def test_source_example_error_halves_with_the_step():
    exact = PROBLEMS["source"].exact(5.0)
    errors = [
        abs(float(jeuler.solve(PROBLEMS["source"].f, -3.0, dt=5 / n, num_steps=n, args=1.0).y[-1]) - exact)
        for n in (250, 500)
    ]
    assert abs(np.log2(errors[0] / errors[1]) - 1) < 0.1


def test_euler_moves_position_with_the_old_velocity():
    x, v = jeuler.euler_step(oscillator, 0.0, (1.0, 2.0), 0.1, (4.0, 0.0))
    assert np.allclose((x, v), (1.0 + 0.1 * 2.0, 2.0 - 0.1 * 4.0))


def test_symplectic_euler_moves_position_with_the_new_velocity():
    x, v = jeuler.symplectic_euler_step(oscillator, 0.0, (1.0, 2.0), 0.1, (4.0, 0.0))
    assert np.allclose((x, v), (1.0 + 0.1 * 1.6, 1.6))


def test_symplectic_euler_agrees_with_diffrax():
    """diffrax's SemiImplicitEuler updates its first variable with the old second one: give it (velocity, position)."""
    terms = (diffrax.ODETerm(lambda t, x, a: -4.0 * x), diffrax.ODETerm(lambda t, v, a: v))
    theirs = diffrax.diffeqsolve(
        terms, diffrax.SemiImplicitEuler(), 0.0, 2.0, 0.01, (jnp.array(0.0), jnp.array(1.0)), max_steps=500
    ).ys
    ours = jeuler.solve(
        oscillator, (1.0, 0.0), dt=0.01, num_steps=200, args=(4.0, 0.0), step=jeuler.symplectic_euler_step
    ).y
    np.testing.assert_allclose((ours[1][-1], ours[0][-1]), (theirs[0][-1], theirs[1][-1]), rtol=1e-12)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(name, dtype):
    y = (jnp.ones(3, dtype), jnp.zeros(3, dtype))
    out = METHODS[name].step(oscillator, jnp.asarray(0.0, dtype), y, jnp.asarray(0.1, dtype), (4.0, 0.1))
    assert [leaf.dtype for leaf in jax.tree.leaves(out)] == [dtype, dtype]


def test_symplectic_euler_wants_a_pair():
    with pytest.raises(ValueError, match="pair"):
        jeuler.solve(lambda t, y, a: -y, 1.0, dt=0.1, num_steps=1, step=jeuler.symplectic_euler_step)


@pytest.mark.parametrize("pair", [lambda x, v: (x, v), lambda x, v: [x, v], lambda x, v: {"p": x, "v": v}])
def test_symplectic_euler_takes_any_container_of_two(pair):
    def f(t, y, args):
        x, v = jax.tree.leaves(y)
        return pair(v, -x)

    y = jeuler.solve(f, pair(1.0, 0.0), dt=0.1, num_steps=1, step=jeuler.symplectic_euler_step).y
    np.testing.assert_allclose([leaf[-1] for leaf in jax.tree.leaves(y)], [0.99, -0.1])


@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.heun_step, jeuler.rk4_step])
def test_a_turn_of_a_small_loop_and_of_its_reverse_is_one_kernel(step):
    """Where XLA makes many kernels of a turn, the reverse of RK4 takes 60 to 90 times the forward run."""

    def lorenz(t, y, p):
        return jnp.stack([p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]])

    def final(y, p):
        return jeuler.solve(lorenz, y, args=p, dt=1e-3, num_steps=500, save_every=500, step=step).y[-1].sum()

    start, p = jnp.ones(3, jnp.float32), jnp.array([10.0, 28.0, 8 / 3], jnp.float32)
    text = jax.jit(jax.grad(final, argnums=(0, 1))).lower(start, p).compile().as_text()
    assert text.count('xla_cpu_small_call="true"') == 2  # there and back
