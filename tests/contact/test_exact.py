"""`Collisions` against the exact motion of balls between planes, worked out from event to event by NumPy."""

import event_driven
import jax
import numpy as np
import pytest

import jeuler
from jeuler import Collisions, Plane

DURATION, DT, BALLS, PLANES = 0.6, 0.01, 4, 3
STEPS = (jeuler.euler_step, jeuler.symplectic_euler_step, jeuler.heun_step, jeuler.rk4_step)
VELOCITY_SHIFT = {  # of the parabola they follow, in dt g
    jeuler.euler_step: -0.5,
    jeuler.symplectic_euler_step: 0.5,
    jeuler.implicit_euler_step: 0.5,
    jeuler.linearly_implicit_euler_step: 0.5,
}


def run(numbers, dt, method, *, steps, num_steps):
    """Where the balls are half-way and at the end; one program for all these steps."""
    position, velocity, mass, radius, points, normals, gravity, restitution = numbers

    def step(f, t, y, dt, args):
        return jax.lax.switch(method, [lambda y, step=step: step(f, t, y, dt, args) for step in steps], y)

    pairs = [(i, j) for i in range(len(position)) for j in range(i)]
    walls = tuple(Plane(*plane) for plane in zip(points, normals, strict=True))
    contact = Collisions(walls, pairs, radius=radius, restitution=restitution)
    scene = jeuler.Scene((jeuler.Gravity(gravity),), (contact,))
    state = jeuler.ParticleState(position, velocity, mass)
    how = {"dt": dt, "num_steps": num_steps, "save_every": num_steps // 2}
    end = jeuler.simulate(scene, state, **how, step=step)
    return end.y.position[1:], end.unresolved_contacts


def at_both(scenes, *, steps=STEPS, balls=BALLS, planes=PLANES):
    """For each step: where the balls of the scenes are at the end with dt and with dt / 2, and what is unresolved."""
    arrays = [
        np.stack(x) for x in zip(*(event_driven.padded(s, count=balls, planes=planes) for s in scenes), strict=True)
    ]
    num_steps = 2 * round(DURATION / DT)
    program = jax.jit(
        jax.vmap(lambda numbers, dt, k: run(numbers, dt, k, steps=steps, num_steps=num_steps), (0, 0, None))
    )
    twice, dts = [np.concatenate([x, x]) for x in arrays], np.repeat([DT, DT / 2], len(scenes))
    for k, step in enumerate(steps):
        position, unresolved = jax.tree.map(np.asarray, program(twice, dts, k))
        position = np.stack([position[: len(scenes), 0], position[len(scenes) :, 1]])
        yield step, position, unresolved.reshape(2, -1)


def compare(scene, step, found):
    """Errors at dt and dt / 2: from the exact motion, and from that with the velocity that the step has in effect.

    And whether an approach is so slow that a bounce is cut short; and whether the events are the same in all three.
    """
    end, _, events = event_driven.exact(scene, DURATION)
    found = found[:, : len(end)]
    same, errors = True, []
    for x, dt in zip(found, (DT, DT / 2), strict=True):
        there = event_driven.shifted(scene, VELOCITY_SHIFT.get(step, 0.0) * dt * scene.gravity)
        own_end, _, own_events = event_driven.exact(there, DURATION)
        same = same and [e[:3] for e in own_events] == [e[:3] for e in events]
        slowest = min((speed for *_, speed in own_events), default=np.inf)
        slow = slowest < 1.01 * dt * np.linalg.norm(scene.gravity)  # then a bounce is cut short
        errors.append((np.max(np.abs(x - end)), np.max(np.abs(x - own_end)), slow))
    return same, errors


@pytest.fixture(scope="module")
def compared():
    scenes = event_driven.random_scenes(np.random.default_rng(5), 12, DURATION, DT, balls=BALLS, planes=PLANES)
    rows = []
    for step, position, unresolved in at_both(scenes):
        for k, scene in enumerate(scenes):
            rows.append((step, scene, *compare(scene, step, position[:, k]), unresolved[:, k]))
    return rows


def test_position_is_that_of_the_exact_motion_where_no_bounce_is_cut_short(compared):
    """The step's own error for a constant force is a shift of the velocity by dt g / 2, or nothing; contact adds none."""
    errors = [own for _, _, _, errors, _ in compared for _, own, slow in errors if not slow]
    assert len(errors) > 50
    assert max(errors) < 1e-11


def test_error_is_half_at_half_the_step(compared):
    ratios = [
        errors[0][0] / errors[1][0]
        for step, scene, same, errors, _ in compared
        if step in VELOCITY_SHIFT and same and scene.gravity.any() and not errors[0][2] and errors[0][0] > 1e-6
    ]
    assert len(ratios) >= 6
    np.testing.assert_allclose(ratios, 2, rtol=0.1)


def test_bounces_that_are_cut_short_leave_an_error_of_first_order(compared):
    """At most that of a velocity that is off by dt g for the whole time."""
    for _, scene, _, errors, unresolved in compared:
        for (_, own, _), dt in zip(errors, (DT, DT / 2), strict=True):
            assert own <= dt * np.linalg.norm(scene.gravity) * DURATION + 1e-11
        assert not unresolved.any()
