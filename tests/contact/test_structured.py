"""Scenes in round numbers: right gradients where four one-sided differences agree, or a count; no energy from nowhere."""

import contact_scenes
import numpy as np
import pytest

SCENES = 12


@pytest.mark.parametrize("method", [0, 1, 3, 5, 6], ids=lambda k: list(contact_scenes.STEPS)[k])
def test_gradients_of_two_balls_a_floor_and_a_wall(method):
    shape = "two balls, floor and wall"
    random = np.random.default_rng(3)
    *_, everything = contact_scenes.programs(shape)
    numbers = contact_scenes.batch([contact_scenes.draw(random, shape) for _ in range(SCENES)], np.float64)
    points = SCENES * 33  # each scene, and four changes of each of its 8 numbers: one batch, one program

    def sums(numbers, method):
        return everything(numbers, method)[0]

    slopes = contact_scenes.differences(sums, numbers, method, at_once=points)
    _, (position, velocity, unresolved), gradient = contact_scenes.in_chunks(everything, numbers, method, points)
    gradient = np.stack([gradient["position"], gradient["velocity"]], axis=1)
    wrong = contact_scenes.wrong_gradients(gradient, slopes)
    assert not wrong[unresolved == 0].any()
    rise, allowed = contact_scenes.rise_of_energy(numbers, position, velocity, method)
    assert np.all((rise <= allowed) | (unresolved > 0))
