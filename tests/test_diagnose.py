"""diagnose names the step, the part, the particle and the cause of each kind of loss."""

import jax.numpy as jnp
import pytest

import jeuler
from jeuler.diagnose import diagnose
from jeuler.implicit import implicit_euler_step

SPRING = jeuler.Scene(forces=(jeuler.Springs([[1, 2]], ks=100.0, kd=1.0, rest_length=1.0),))
STRETCHED = jeuler.ParticleState(jnp.array([[0.0], [0.0], [1.1]]), jnp.zeros((3, 1)))
COINCIDENT = jeuler.ParticleState(jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), jnp.zeros((3, 2)))
GRAVITY = jeuler.Scene(forces=(jeuler.Gravity([0.0, -1.0]),))


def test_finite_run():
    found = diagnose(SPRING, STRETCHED, dt=1e-3, num_steps=50, loss=lambda s: jnp.sum(s.position**2))
    assert found.finite
    assert "finite" in str(found)


def test_step_over_the_stability_limit_says_by_what_factor():
    """mu = 1/2: omega = sqrt(200), explicit limit kd / ks = 0.01 s."""
    found = diagnose(SPRING, STRETCHED, dt=0.5, num_steps=1000)
    run = jeuler.simulate(SPRING, STRETCHED, dt=0.5, num_steps=1000)
    assert found.step == int(run.first_nonfinite) > 1
    assert found.part == "forces[0] Springs"
    assert found.particles == (1, 2)
    assert found.springs == (0,)
    assert "50 times the stability limit 0.01 s of euler_step" in found.cause
    assert "implicit_euler_step" in found.remedy


def test_no_stable_step_for_an_undamped_spring_under_explicit_euler():
    undamped = jeuler.Scene(forces=(jeuler.Springs([[1, 2]], ks=100.0, kd=0.0, rest_length=1.0),))
    found = diagnose(undamped, STRETCHED, dt=0.5, num_steps=1000)
    assert "no dt is stable" in found.cause
    assert "symplectic_euler_step" in found.remedy


def direction_to_first(t, position, velocity, mass):
    d = position[0] - position
    return d / jnp.linalg.norm(d, axis=-1, keepdims=True)


def test_coincident_pair_in_a_force():
    scene = jeuler.Scene((jeuler.Gravity([0.0, -1.0]), direction_to_first))
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=3)
    assert (found.step, found.part, found.particles) == (1, "forces[1] direction_to_first", (0, 1))
    assert "particles 0 and 1 coincide" in found.cause


def pull_with_a_root(t, position, velocity, mass):
    return -position * jnp.sqrt(jnp.sum(position**2, axis=-1, keepdims=True))


def test_gradient_lost_in_a_force_whose_value_is_finite():
    scene = jeuler.Scene((pull_with_a_root,))
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=3, loss=lambda s: jnp.sum(s.position**2))
    assert not found.finite
    assert (found.quantity, found.step, found.part) == ("gradient", 3, "forces[0] pull_with_a_root")
    assert found.particles == (0, 1)
    assert "derivative" in found.cause


def test_gradient_lost_in_the_loss():
    def distance(state):
        return jnp.linalg.norm(state.position[0] - state.position[1])

    found = diagnose(GRAVITY, COINCIDENT, dt=0.1, num_steps=3, loss=distance)
    assert (found.quantity, found.part, found.particles) == ("gradient", "loss", (0, 1))


def test_nan_in_the_initial_state_and_in_a_parameter():
    state = jeuler.ParticleState([[0.0, 0.0], [jnp.nan, 1.0]], [[0.0, 0.0], [0.0, 1.0]])
    found = diagnose(GRAVITY, state, dt=0.1, num_steps=3)
    assert (found.step, found.part, found.particles) == (0, "state.position", (1,))
    found = diagnose(jeuler.Scene((jeuler.Gravity([0.0, jnp.inf]),)), COINCIDENT, dt=0.1, num_steps=3)
    assert (found.step, found.part) == (0, "scene.forces[0].acceleration")


def test_tiny_mass_overflows_in_float32_only():
    mass = jnp.array([1.0, 1e-38, 1.0], jnp.float32)
    single = jeuler.ParticleState(STRETCHED.position.astype("float32"), jnp.zeros((3, 1), "float32"), mass)
    found = diagnose(SPRING, single, dt=0.1, num_steps=1)
    assert (found.step, found.part, found.particles) == (1, "acceleration", (1,))
    assert "float32" in found.cause


def test_effect_that_divides_by_zero_and_the_key_of_its_step():
    import jax

    def lottery(t, dt, state, key):
        bad = jax.random.uniform(key) < 0.1
        factor = jnp.where(bad, jnp.nan, 1.0)
        return jeuler.ParticleState(state.position.at[2].multiply(factor), state.velocity, state.mass)

    scene, key = jeuler.Scene(GRAVITY.forces, (lottery,)), jax.random.key(3)
    run = jeuler.simulate(scene, COINCIDENT, dt=0.1, num_steps=60, key=key)
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=60, key=key)
    assert found.step == int(run.first_nonfinite) > 1
    assert (found.part, found.particles) == ("effects[0] lottery", (2,))


def test_implicit_step_that_does_not_converge():
    explosion = jeuler.Scene((lambda t, x, v, m: 1e3 * jnp.exp(x),))
    found = diagnose(explosion, STRETCHED, dt=0.5, num_steps=5, step=implicit_euler_step)
    assert (found.step, found.part) == (1, "implicit_euler_step")
    assert "did not converge" in found.cause


def test_exploding_cotangent():
    """y -> 1e30 y a step: the value, from 0, stays 0; its derivative overflows."""
    scene = jeuler.Scene((lambda t, x, v, m: 1e60 * x,))
    rest = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    found = diagnose(scene, rest, dt=1.0, num_steps=20, loss=lambda s: jnp.sum(s.position))
    assert found.quantity == "gradient"
    assert "grew" in found.cause
    assert "cap_cotangent" in found.remedy


def test_bad_input_is_refused_as_in_simulate():
    with pytest.raises(ValueError, match="dt"):
        diagnose(SPRING, STRETCHED, dt=-1.0, num_steps=5)
