"""The implicit midpoint rule: its order, its invariants, and no damping of its own in a fit."""

import jax
import jax.numpy as jnp
import numpy as np
from cases import PROBLEMS

import jeuler


def test_second_order():
    problem = PROBLEMS["oscillator"]
    exact = problem.exact(problem.t1)[0]

    def error(n):
        options = {"dt": problem.t1 / n, "num_steps": n, "args": problem.args, "step": jeuler.implicit_midpoint_step}
        return abs(jeuler.solve(problem.f, problem.y0, **options).y[0][-1] - exact)

    assert abs(np.log2(error(40) / error(80)) - 2) < 0.1


def test_a_stiff_pendulum_keeps_its_energy():
    """On a spring of 1e7 N/m, for 0.5 s; implicit Euler loses 1 % of m g L in that time."""
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=1e7, kd=0.0, rest_length=1.0), jeuler.Gravity([0.0, -9.81])))
    bob = jeuler.ParticleState([[0.0, 0.0], [1.0, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 1.0])
    run = jeuler.simulate(scene, bob, dt=1e-3, num_steps=500, save_every=50, step=jeuler.implicit_midpoint_step).y
    energy = jax.vmap(lambda x, v, m: scene.energy(0.0, (x, v), m))(run.position, run.velocity, run.mass)
    np.testing.assert_allclose(energy, energy[0], atol=1e-4 * 9.81)


def test_damping_fitted_through_it_is_that_of_the_spring():
    omega, kd, t = 30.0, 0.5, np.linspace(0.0, 1.0, 101)
    rate = np.sqrt(omega**2 - kd**2 / 4)
    x = 1 + 0.2 * np.exp(-kd * t / 2) * (np.cos(rate * t) + kd / 2 / rate * np.sin(rate * t))
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=890.0, kd=0.3, rest_length=1.0),))
    state = jeuler.ParticleState([[0.0], [1.2]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    positions = np.stack([0 * t, x], axis=1)[:, :, None]
    options = {"dt": 0.0025, "step": jeuler.implicit_midpoint_step, "step_bias": False, "start": "given", "grow": False}
    found = jeuler.fit_springs(scene, state, t, positions, **options)
    assert abs(float(found.kd) - kd) < 0.005, "implicit Euler gives 0"
