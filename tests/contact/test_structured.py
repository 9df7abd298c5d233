"""Scenes in round numbers: right gradients where four one-sided differences agree, or a count; no energy from nowhere."""

import contact_scenes
import numpy as np
import pytest

SCENES = 8  # drawn, beside those that were wrong once


def scene(
    position, velocity, *, mass=(1.0, 1.0), wall=(1.0, 0.0), gravity=-9.8, restitution=1.0, friction=0.0, dt=0.02
):
    return {
        "position": np.array(position),
        "velocity": np.array(velocity),
        "mass": np.array(mass),
        "normals": np.array([(0.0, 1.0), wall]),
        "gravity": np.array([0.0, gravity]),
        "restitution": np.array(restitution),
        "friction": np.array(friction),
        "dt": np.array(dt),
    }


WRONG_ONCE = [
    scene([(0.1, 0.1), (1.25, 0.1)], [(0.0, 0.0), (0.0, 0.0)], gravity=-10.0, dt=1 / 30),  # rest beside an implicit step
    scene([(0.3, 0.1), (0.3, 0.3)], [(0.0, 1.0), (0.0, -1.0)], restitution=0.5, friction=0.3),  # touching, in free fall
    scene([(0.1, 0.1), (0.1, 0.3)], [(-0.5, 0.0), (-0.5, 0.0)], restitution=0.0),  # a stack beside a wall
    scene(  # touches a floor without a load as it meets a wall
        [(1 / 30, 0.1), (0.65, 0.1)], [(-0.5, 0.0), (-1.0, 0.0)], mass=(2.0, 1.0), wall=(0.6, 0.8), gravity=0.0,
        restitution=0.5, friction=0.3, dt=1 / 30,
    ),
    scene(  # a rounding that pushes had another derivative where reverse mode computes it again
        [(0.2, 0.1), (0.2, 0.3)], [(0.5, 0.0), (0.0, 0.0)], mass=(0.5, 1.0), gravity=-10.0, restitution=0.5, dt=1 / 60
    ),
]  # fmt: skip


@pytest.mark.parametrize("method", [0, 1, 3, 5, 6], ids=lambda k: list(contact_scenes.STEPS)[k])
def test_gradients_of_two_balls_a_floor_and_a_wall(method):
    shape = "two balls, floor and wall"
    random = np.random.default_rng(3)
    *_, everything = contact_scenes.programs(shape)
    scenes = WRONG_ONCE + [contact_scenes.draw(random, shape) for _ in range(SCENES)]
    numbers = contact_scenes.batch(scenes, np.float64)
    points = len(scenes) * 33  # each scene, and four changes of each of its 8 numbers: one batch, one program

    def sums(numbers, method):
        return everything(numbers, method)[0]

    slopes = contact_scenes.differences(sums, numbers, method, at_once=points)
    _, (position, velocity, unresolved), gradient = contact_scenes.in_chunks(everything, numbers, method, points)
    gradient = np.stack([gradient["position"], gradient["velocity"]], axis=1)
    wrong = contact_scenes.wrong_gradients(gradient, slopes)
    assert not wrong[unresolved == 0].any()
    rise, allowed = contact_scenes.rise_of_energy(numbers, position, velocity, method)
    assert np.all((rise <= allowed) | (unresolved > 0))
