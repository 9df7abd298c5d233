"""What observations show: against closed forms of a swing, a frame that turns, a camera; and with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import observing

KS, KD, LENGTH, MASS = 8.0, 0.5, 1.0, 2.0
SCENE = jeuler.Scene((jeuler.Gravity([0.0, -10.0]), jeuler.Springs([[0, 1], [1, 2]], [KS, 3.0], [KD, 0.0], LENGTH)))
STATE = jeuler.ParticleState(
    [[0.0, 0.0], [3.0, 4.0], [3.0, 4.0]], [[0.0, 0.0], [0.5, 1.0], [0.5, 1.0]], mass=[jnp.inf, MASS, 1.0]
)
UNIT = np.array([0.6, 0.8])
PULL = KS * (5 - LENGTH) + KD * (0.6 * 0.5 + 0.8 * 1.0)  # the second spring's ends coincide: it pulls nowhere
ACCELERATION = -PULL * UNIT / MASS + [0.0, -10.0]
CAMERA = [[100.0, 0.0, 50.0], [0.0, 0.0, 7.0], [0.0, 1.0, 2.0]]

SHOWN = {
    "position": (observing.Position(), np.asarray(STATE.position)),
    "position of some": (observing.Position([2, 0]), np.asarray(STATE.position)[[2, 0]]),
    "velocity": (observing.Velocity([1]), [[0.5, 1.0]]),
    "acceleration": (observing.Acceleration([1]), [ACCELERATION]),
    "acceleration of what is pinned": (observing.Acceleration([0]), [[0.0, 0.0]]),
    "an accelerometer": (observing.Acceleration([1], gravity=[0.0, -10.0]), [ACCELERATION - np.array([0.0, -10.0])]),
    "one at rest": (observing.Acceleration([0], gravity=[0.0, -10.0]), [[0.0, 10.0]]),
    "distance": (observing.Distance([0, 1]), 5.0),
    "distances, one of them 0": (observing.Distance([[1, 0], [1, 2]]), [5.0, 0.0]),
    "angle": (observing.Angle([0, 1]), np.arctan2(3.0, -4.0)),
    "angle from x": (observing.Angle([[0, 1]], zero=[2.0, 0.0]), [np.arctan2(4.0, 3.0)]),
    "spring force": (observing.SpringForce(), [PULL, -3.0 * LENGTH]),
    "of one spring": (observing.SpringForce([1]), [-3.0 * LENGTH]),
    "camera": (observing.Projection(CAMERA, [1]), [[350.0 / 6, 7.0 / 6]]),
    "sensor": (observing.Sensor(observing.Distance([0, 1]), gain=2.0, bias=[1.0]), [11.0]),
    "sensor by name": (observing.Sensor("velocity", gain=[1.0, 10.0]), np.asarray(STATE.velocity) * [1.0, 10.0]),
}


@pytest.mark.parametrize("name", SHOWN)
def test_an_observation_shows_the_closed_form(name):
    observation, expected = SHOWN[name]
    observation.check(SCENE, *STATE.position.shape)
    np.testing.assert_allclose(observation(0.0, SCENE, STATE), expected, rtol=1e-12, atol=1e-12)


def test_derivatives_are_finite_also_where_ends_coincide_and_follow_the_dtype():
    names = ("distances, one of them 0", "angle", "spring force", "camera")
    observations = [SHOWN[name][0] for name in names]

    def all_of_them(scene, state):
        return [observation(0.0, scene, state) for observation in observations]

    slopes = jax.jacfwd(lambda p: all_of_them(SCENE, jeuler.ParticleState(p, STATE.velocity, STATE.mass)))(
        STATE.position
    )
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (SCENE, STATE))
    assert {shown.dtype for shown in jax.eval_shape(all_of_them, *single)} == {jnp.dtype("float32")}


WRONG = {
    "no integers": (lambda: observing.Position([0.5]), "Position.particles must be integers"),
    "one twice": (lambda: observing.Velocity([1, 1]), "Velocity.particles must be different particles"),
    "three ends": (lambda: observing.Distance([0, 1, 2]), r"Distance.pairs must have shape \(2,\) or \(k, 2\)"),
    "no direction": (lambda: observing.Angle([0, 1], zero=[0.0, 0.0]), "Angle.zero must point somewhere"),
    "no delay": (lambda: observing.Sensor("position", delay=np.nan), "Sensor.delay must be one finite real number"),
    "no such name": (lambda: observing.Sensor("speed"), "observe must be 'position', 'velocity', 'acceleration'"),
    "a class": (lambda: observing.Sensor(observing.Position), r"write Position\(...\)"),
    "one argument": (lambda: observing.Sensor(lambda state: 0), "of 1 arguments"),
    "out of range": (
        lambda: observing.Position([3]).check(SCENE, 3, 2),
        "Position.particles must be indices from 0 to 2",
    ),
    "no such spring": (lambda: observing.SpringForce([2]).check(SCENE, 3, 2), "from 0 to 1"),
    "no springs": (lambda: observing.SpringForce().check(jeuler.Scene(), 3, 2), "needs a scene with springs"),
    "in space": (lambda: observing.Angle([0, 1]).check(SCENE, 3, 3), "Angle needs positions in the plane"),
    "another matrix": (lambda: observing.Projection(CAMERA).check(SCENE, 3, 3), r"must have shape \(3, 4\)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_observation_is_told_in_one_line(name):
    call, words = WRONG[name]
    with pytest.raises(ValueError, match=words):
        call()


def test_functions_of_the_user_get_what_they_ask_for():
    of_scene, of_time = lambda scene, state: scene.forces[1].ks[0], lambda t, state: t + state.position[1, 0]
    all_three = lambda t, scene, state: t * scene.forces[1].ks[0] + state.position[1, 0]  # noqa: E731
    shown = [observing.Sensor(f)(2.0, SCENE, STATE).item() for f in (of_scene, of_time, all_three)]
    assert shown == [8.0, 5.0, 19.0]
