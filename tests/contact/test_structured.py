"""Scenes in round numbers: right gradients where four one-sided differences agree, or a count; no energy from nowhere."""

import contact_scenes
import numpy as np
import pytest

SCENES = 7  # drawn, beside those that were wrong once


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
    scene([(0.1, 0.1), (1.25, 0.1)], [(0.0, 0.0), (0.0, 0.0)], gravity=-10.0, dt=1 / 30),  # rest
    scene([(0.3, 0.1), (0.3, 0.3)], [(0.0, 1.0), (0.0, -1.0)], restitution=0.5, friction=0.3),  # touching, in free fall
    scene([(0.1, 0.1), (0.1, 0.3)], [(-0.5, 0.0), (-0.5, 0.0)], restitution=0.0),  # a stack beside a wall
    scene(  # touches a floor without a load as it meets a wall
        [(1 / 30, 0.1), (0.65, 0.1)], [(-0.5, 0.0), (-1.0, 0.0)], mass=(2.0, 1.0), wall=(0.6, 0.8), gravity=0.0,
        restitution=0.5, friction=0.3, dt=1 / 30,
    ),
    scene(  # a rounding that pushes had another derivative where reverse mode computes it again
        [(0.2, 0.1), (0.2, 0.3)], [(0.5, 0.0), (0.0, 0.0)], mass=(0.5, 1.0), gravity=-10.0, restitution=0.5, dt=1 / 60
    ),
    # one lies on another that meets the floor, without a load: nothing holds it, and roundings do not push
    scene([(0.3, 0.1), (0.3, 0.1 * 3)], [(0.0, -0.5), (0.0, 0.0)], gravity=0.0, restitution=0.0, friction=0.3),
]  # fmt: skip


TIED = [  # what rounding decides: counted, whatever their gradient is
    scene(
        [(1 / 30, 0.1), (0.3 + 2 / 30 + 0.25, 0.1)], [(0.0, -1.0), (0.0, -1.0)], mass=(1.0, 0.5), wall=(0.6, 0.8),
        friction=0.3, dt=1 / 30,
    ),  # a ball falls into a corner
    # falls on the floor as it meets another: the order decides nothing but the derivative for where they meet
    scene([(0.34, 0.1), (0.54, 0.1)], [(1.0, -1.0), (0.5, 1.0)], gravity=0.0, dt=0.01),
    # bounce on the floor, one over the other: they are left touching, without a load or a motion against each other
    scene([(0.2, 0.1), (0.2, 0.3)], [(-0.5, 0.5), (-0.5, 0.5)], gravity=-10.0, dt=1 / 60),
    # slows down with another on it that friction holds just so
    scene([(0.2, 0.1), (0.2, 0.3)], [(1.0, 0.0), (1.0, 0.0)], mass=(2.0, 0.5), friction=0.3, dt=0.01),
]  # fmt: skip
GAINED = [  # one slides over another that stands on the floor
    scene([(0.1, 0.1), (0.1, 0.3)], [(-0.5, 0.0), (0.5, 0.0)], restitution=0.5, dt=0.01),
    scene([(0.1, 0.1), (0.1, 0.3)], [(-0.5, 0.0), (-1.0, 0.0)], gravity=-10.0, dt=1 / 60),
]
GLIDE = scene(  # two that touch each other and a slope, without a load: each change of a place has one contact or the other
    [(0.236, 0.302), (0.396, 0.422)], [(0.8, 0.6), (0.8, 0.6)], gravity=0.0, restitution=0.0, dt=0.01
) | {"normals": np.array([(-0.6, 0.8), (1.0, 0.0)])}  # fmt: skip
STEPS = ("euler", "symplectic", "Heun", "RK4")  # in one program; the others in `benchmarks/contact.py fuzz`


@pytest.mark.parametrize("method", range(len(STEPS)), ids=STEPS)
def test_gradients_of_two_balls_a_floor_and_a_wall(method):
    shape = "two balls, floor and wall"
    random = np.random.default_rng(3)
    _, everything, _ = contact_scenes.programs(shape, STEPS, few=True)
    scenes = [*TIED, GLIDE, *GAINED, *WRONG_ONCE, *(contact_scenes.draw(random, shape) for _ in range(SCENES))]
    numbers = contact_scenes.batch(scenes, np.float64)
    points = len(scenes) * 33  # each scene, and four changes of each of its 8 numbers: one batch, one program

    def sums(numbers, method):
        return everything(numbers, method)[0]

    slopes = contact_scenes.differences(sums, numbers, method, at_once=points)
    _, runs, gradient = contact_scenes.in_chunks(everything, numbers, method, points)
    position, velocity, unresolved, _ = runs
    wrong = contact_scenes.wrong_gradients(gradient, slopes)
    assert not wrong[unresolved == 0].any()
    assert (unresolved[: len(TIED)] > 0).all()
    assert not contact_scenes.agree(slopes)[len(TIED), 0, 0, 1]  # of GLIDE
    rise, allowed = contact_scenes.rise_of_energy(numbers, position, velocity, STEPS[method])
    assert not ((rise > allowed) & (unresolved == 0)).any()
