"""A step of a scene: who is called when, with what, in which of the forms that a person may write."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler._core.component import component

STATE = jeuler.ParticleState(jnp.zeros((2, 1)), jnp.ones((2, 1)))
RUN = {"dt": 0.25, "num_steps": 2}


def moved_by(effect):
    return jeuler.simulate(jeuler.Scene(effects=(effect,)), STATE, **RUN).y.velocity[1:, 0, 0].tolist()


def stamp(previous, state):
    """Where the particle was before the motion and where it is, in one number."""
    return dataclasses.replace(state, velocity=100 * previous.position + state.position + 1)


def five(t, dt, previous, state, key):
    return stamp(previous, state)


@component()
class Five:
    scale: float = 1.0

    def __call__(self, t, dt, previous, state, key):
        return stamp(previous, state)


@component()
class OverStep:
    """As effects of one's own that need the state before were written."""

    scale: float = 1.0

    def __call__(self, t, dt, state, key):
        raise AssertionError("over_step is called instead")

    def over_step(self, t, dt, previous, state, key):
        return stamp(previous, state)


@pytest.mark.parametrize("effect", [five, Five(), OverStep()])
def test_an_effect_gets_the_state_before_the_motion(effect):
    """0 -> 0.25 at 1 m/s, then v = 0 + 0.25 + 1, and 0.25 -> 0.5625 with 100 0.25 + 0.5625 + 1."""
    assert np.allclose(moved_by(effect), [1.25, 26.5625])


def double(t, dt, state, key, factor=2.0):
    return dataclasses.replace(state, velocity=factor * state.velocity)


@component()
class Double:
    factor: float = 2.0

    def __call__(self, t, dt, state, key):
        return dataclasses.replace(state, velocity=self.factor * state.velocity)


@pytest.mark.parametrize("effect", [double, Double(), jax.tree_util.Partial(double, factor=jnp.asarray(2.0))])
def test_an_effect_of_four_arguments_is_called_without_previous(effect):
    assert moved_by(effect) == [2.0, 4.0]


@pytest.mark.parametrize("effect", [lambda t, state: state, lambda t, dt, state: state, lambda a, b, c, d, e, f: d])
def test_an_effect_of_other_arguments_is_refused_when_the_scene_is_made(effect):
    with pytest.raises(ValueError, match=r"an effect must be a function \(t, dt, previous, state, key\) -> state"):
        jeuler.Scene(effects=(effect,))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ({}, [0, 1.25, 1.5]),
        ({"before_motion": True}, [0, 1, 1.25]),
        ({"acts": "before motion"}, [0, 1, 1.25]),
        ({"acts": "after motion"}, [0, 1.25, 1.5]),
        ({"acts": "start and after motion"}, [1, 1.25, 1.5]),
    ],
)
def test_when_an_effect_acts(words, expected):
    @jeuler.uses(**words)
    def stamp_time(t, dt, state, key):
        return dataclasses.replace(state, velocity=jnp.full_like(state.velocity, 1 + t))

    rest = dataclasses.replace(STATE, velocity=jnp.zeros((2, 1)))
    run = jeuler.simulate(jeuler.Scene(effects=(stamp_time,)), rest, **RUN)
    assert np.allclose(run.y.velocity[:, 0, 0], expected)


def test_an_unknown_word_for_when_is_refused():
    with pytest.raises(ValueError, match="acts must be one of 'before motion', .* got 'later'"):
        jeuler.uses(acts="later")


def test_effects_of_the_library_may_be_called_by_hand_without_previous():
    t, dt = jnp.asarray(0.0), jnp.asarray(0.1)
    limit = jeuler.SpeedLimit(0.5)
    for arguments in ((t, dt, STATE, None), (t, dt, STATE, STATE, None)):
        assert limit(*arguments).velocity.tolist() == [[0.5], [0.5]]
    assert limit(t=t, dt=dt, state=STATE, key=None).velocity.tolist() == [[0.5], [0.5]]
    floor = jeuler.Collisions((jeuler.Plane([0.05], [-1.0]),), restitution=1.0)
    after = dataclasses.replace(STATE, position=STATE.position + 0.1)
    for arguments in ((t + dt, dt, after, None), (t + dt, dt, STATE, after, None)):
        assert np.allclose(floor(*arguments).velocity, -1)


@pytest.mark.parametrize("mass", [2.0, [2.0, 2.0]])
def test_a_force_gets_the_mass_of_each_particle(mass):
    def weight(t, position, velocity, mass):
        assert mass.shape == (2,)
        return -10 * mass[:, None] * jnp.ones_like(position)

    state = dataclasses.replace(STATE, mass=jnp.asarray(mass))
    assert np.allclose(jeuler.simulate(jeuler.Scene((weight,)), state, **RUN).y.velocity[:, 0, 0], [1, -1.5, -4])
    slope = jeuler.Scene((weight,)).vector_field(0.0, (state.position, state.velocity), mass)
    assert np.allclose(slope[1], -10)


def test_a_force_that_reads_a_field_and_gets_a_mass_alone_says_what_to_pass():
    @jeuler.uses(reads=("heat",))
    def rise(t, position, velocity, mass, heat):
        return heat[:, None] * jnp.ones_like(position)

    scene, state = jeuler.Scene((rise,)), STATE.replace(heat=jnp.ones(2))
    y = state.position, state.velocity
    with pytest.raises(ValueError, match=r"reads 'heat', got a mass alone; pass args=scene.attributes\(state\)"):
        scene.vector_field(0.0, y, state.mass)
    assert np.allclose(scene.vector_field(0.0, y, scene.attributes(state))[1], 1)
    run = jeuler.solve(scene.vector_field, y, args=scene.attributes(state), **RUN)
    assert np.allclose(run.y[1], jeuler.simulate(scene, state, **RUN).y.velocity)


@pytest.mark.parametrize("collider", [jeuler.Plane([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), jeuler.Sphere([0.0], 1.0)])
def test_death_on_contact_with_a_collider_of_another_dimension_is_refused(collider):
    state = jeuler.ParticleState(jnp.zeros((2, 2)), jnp.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"must have shape \(2,\)"):
        jeuler.simulate(jeuler.Scene(effects=(jeuler.DeathOnContact(collider),)), state, **RUN)


def test_empty_springs_leave_no_trace():
    empty = jeuler.Springs([], 1.0, 1.0, 1.0)

    def program(*forces):
        return str(jax.make_jaxpr(lambda s: jeuler.simulate(jeuler.Scene(forces), s, **RUN).y.position)(STATE))

    gravity = jeuler.Gravity([-9.81])
    assert program(gravity, empty) == program(gravity)
    assert program(empty) == program()
