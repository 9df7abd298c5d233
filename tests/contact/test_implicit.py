"""Contact at rest beside steps that solve for their end: it is part of what they solve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import Collisions, Plane
from jeuler.contact.contacts import Contacts
from jeuler.contact.impacts import Events, strike
from jeuler.contact.paths import free_path, share_of_the_force

G = 9.8
FLOOR = Plane([0.0, 0.0], [0.0, 1.0])
GRAVITY = jeuler.Gravity([0.0, -G])
IMPLICIT = jeuler.implicit_euler_step


def two_balls(ks, height, step, **contact):
    """Two balls of 1 kg above each other, joined by a spring of 1 m, whose lower one is at this height."""
    position = jnp.array([[0.0, 0.1], [0.0, 1.1]]) + jnp.array([0.0, 1.0]) * height
    floor = Collisions((FLOOR,), radius=0.1, **contact)
    scene = jeuler.Scene((GRAVITY, jeuler.Springs([[0, 1]], ks, 1.0, 1.0)), (floor,))
    state = jeuler.ParticleState(position, 0 * position)
    return jeuler.simulate(scene, state, dt=0.01, num_steps=200, save_every=40, step=step)


@pytest.mark.parametrize("step", [IMPLICIT, jeuler.linearly_implicit_euler_step], ids=lambda step: step.__name__)
def test_a_stiff_spring_on_the_floor_carries_the_weight(step):
    """At once where it stands there, and after a fall of half a metre."""

    def shortened(ks, height):
        run = two_balls(ks, height, step, restitution=0.3, friction=0.5)
        return 1 - (run.y.position[1:, 1, 1] - run.y.position[1:, 0, 1]), run

    ks, height = jnp.array([1e6, 1e8, 1e8]), jnp.array([0.0, 0.0, 0.5])
    by, run = jax.jit(jax.vmap(shortened))(ks, height)
    np.testing.assert_allclose(ks[:2, None] * by[:2], G, rtol=1e-6)
    np.testing.assert_allclose(ks[2] * by[2, -1], G, rtol=1e-6)
    np.testing.assert_allclose(run.y.position[:, -1, 0], np.broadcast_to([0.0, 0.1], (3, 2)), atol=1e-12)
    np.testing.assert_array_equal(run.unresolved_contacts, 0)


def test_the_midpoint_rule_holds_the_balls_but_its_stiff_spring_is_not_to_be_read():
    """As its docstring says: the places are right, the force in the spring is not that of the weight."""
    run = two_balls(1e8, 0.0, jeuler.implicit_midpoint_step)
    np.testing.assert_allclose(run.y.position[:, :, 1], np.broadcast_to([0.1, 1.1], (6, 2)), atol=1e-4)
    force = 1e8 * (1 - (run.y.position[1:, 1, 1] - run.y.position[1:, 0, 1]))
    assert np.abs(force / G - 1).max() > 1


def test_gradient_of_a_spring_at_rest_on_the_floor():
    def height(ks):
        return two_balls(ks, 0.0, IMPLICIT).y.position[-1, 1, 1]

    ks = 1e5
    value, slope = jax.jit(jax.value_and_grad(height))(ks)
    np.testing.assert_allclose(value, 1.1 - G / ks, rtol=1e-12)
    np.testing.assert_allclose(slope, G / ks**2, rtol=1e-6)


def test_two_balls_with_a_spring_hold_on_a_slope_or_slide_as_one():
    """Friction at rest is part of the solve too."""
    angle = np.deg2rad(20.0)
    normal, along = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    position = 0.1 * normal + np.array([[0.0], [1.0]]) * along

    def speed(friction):
        contact = Collisions((Plane([0.0, 0.0], normal),), radius=0.1, friction=friction)
        scene = jeuler.Scene((GRAVITY, jeuler.Springs([[0, 1]], 1e6, 1.0, 1.0)), (contact,))
        state = jeuler.ParticleState(jnp.asarray(position), jnp.zeros((2, 2)))
        return jeuler.simulate(scene, state, dt=0.01, num_steps=50, step=IMPLICIT).y.velocity[-1] @ along

    friction = np.array([0.0, 0.2, 0.5])
    right = -G * 0.5 * np.maximum(np.sin(angle) - friction * np.cos(angle), 0)
    np.testing.assert_allclose(jax.jit(jax.vmap(speed))(friction), np.stack([right, right], 1), atol=1e-6)


def test_stack_of_balls_and_a_spring_beside_an_implicit_step():
    """Three balls on each other, the upper two joined: contact between balls and the spring share the weight."""
    position = np.array([[0.0, 0.1], [0.0, 0.3], [0.0, 0.8]])
    contact = Collisions((FLOOR,), pairs=[(0, 1), (1, 2)], radius=0.1)
    scene = jeuler.Scene((GRAVITY, jeuler.Springs([[1, 2]], 1e7, 1.0, 0.5)), (contact,))
    state = jeuler.ParticleState(jnp.asarray(position), jnp.zeros((3, 2)))
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=100, save_every=50, step=IMPLICIT)
    shortened = 0.5 - (run.y.position[1:, 2, 1] - run.y.position[1:, 1, 1])
    np.testing.assert_allclose(1e7 * shortened, G, rtol=1e-6)
    np.testing.assert_allclose(run.y.position[1:, :2], np.stack([position[:2]] * 2), atol=1e-12)
    assert int(run.unresolved_contacts) == 0


def test_parts_of_an_extrapolated_step_have_the_same_contacts():
    """One ball leaves from under another, so that the gap opens within the step: were it looked at in each part, parts
    of other lengths would have contact forces of other shares, and what is extrapolated from them energy."""
    step = jeuler.extrapolated_euler(3, step=jeuler.linearly_implicit_euler_step)
    slide = Collisions((FLOOR,), [(0, 1)], radius=0.1, restitution=0.5)
    position = jnp.array([[0.3, 0.1], [0.3, 0.3]])

    @jax.jit
    @jax.vmap
    def run(speed):
        velocity = jnp.zeros((2, 2)).at[0].set(speed)
        scene = jeuler.Scene((GRAVITY,), (slide,))
        return jeuler.simulate(scene, jeuler.ParticleState(position, velocity), dt=0.01, num_steps=24, step=step)

    changes = jnp.array([[0.0, 0.0], [1e-6, 0.0], [-1e-6, 0.0], [0.0, 1e-6]])
    runs = run(jnp.array([0.5, 0.0]) + changes)
    energy = np.sum(runs.y.velocity**2 / 2 + G * runs.y.position * np.array([0.0, 1.0]), axis=(2, 3))
    assert np.max(energy - energy[:, :1]) < 1e-3
    np.testing.assert_allclose(runs.y.position[1:], runs.y.position[:1].repeat(3, 0), atol=1e-5)


@pytest.mark.parametrize("step", [IMPLICIT, jeuler.linearly_implicit_euler_step], ids=lambda step: step.__name__)
def test_derivative_of_a_ball_that_a_wall_takes_off_its_floor(step):
    """What the floor no longer carries then has a derivative, as the solve had that of its force."""
    corner = Collisions((FLOOR, Plane([0.0, 0.0], [0.6, 0.8])), radius=0.1, restitution=1.0, friction=0.3)

    @jax.jit
    def end(velocity):
        state = jeuler.ParticleState(jnp.array([[1 / 30, 0.1]]), velocity[None])
        return jeuler.simulate(jeuler.Scene((GRAVITY,), (corner,)), state, dt=0.02, num_steps=3, step=step).y.position[
            -1, 0
        ]

    velocity = jnp.array([-0.5, 0.0])
    derivative = jax.jacrev(end)(velocity)
    for change in (1e-6, -1e-6):
        moved = [(end(velocity.at[k].add(change)) - end(velocity)) / change for k in range(2)]
        np.testing.assert_allclose(derivative.T, moved, atol=1e-6)
    assert end(velocity)[1] > 0.103


def test_contact_with_nothing_adds_nothing_to_the_solve():
    state = jeuler.ParticleState([[0.0, 1.0]], [[0.5, 0.0]])
    ends = [
        jeuler.simulate(jeuler.Scene((GRAVITY,), effects), state, dt=0.1, num_steps=3, step=IMPLICIT).y
        for effects in ((), (Collisions(),))
    ]
    np.testing.assert_allclose(ends[1].position, ends[0].position, rtol=1e-12)
    np.testing.assert_allclose(ends[1].velocity, ends[0].velocity, rtol=1e-12)


def test_net_of_many_balls_stands_on_the_floor():
    """More unknowns than are solved for with a matrix: the floor carries the whole net, each vertical layer its part."""
    wide, high = 8, 9
    position = np.array([[0.5 * x, 0.1 + 0.5 * y] for y in range(high) for x in range(wide)])
    node = np.arange(wide * high).reshape(high, wide)
    neighbours = [(node[:, :-1], node[:, 1:]), (node[:-1], node[1:]), (node[:-1, :-1], node[1:, 1:])]
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in neighbours])
    rest = np.linalg.norm(position[edges[:, 1]] - position[edges[:, 0]], axis=1)
    scene = jeuler.Scene(
        (GRAVITY, jeuler.Springs(edges, 1e6, 10.0, rest)), (Collisions((FLOOR,), radius=0.1, friction=0.5),)
    )
    state = jeuler.ParticleState(jnp.asarray(position), jnp.zeros_like(position))
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=100, save_every=100, step=IMPLICIT)
    end = np.asarray(run.y.position[-1])
    d = end[edges[:, 1]] - end[edges[:, 0]]
    push = (1e6 * (rest / np.linalg.norm(d, axis=1) - 1))[:, None] * d
    between = (edges[:, 0] < wide) & (edges[:, 1] >= wide)
    np.testing.assert_allclose(push[between].sum(0), [0.0, G * wide * (high - 1)], atol=1e-4)
    np.testing.assert_allclose(end[:wide, 1], 0.1, atol=1e-12)


def test_plastic_landing_holds_the_derivative_of_a_force_that_the_solve_holds():
    """The path of a ball that a solve holds is straight; forced by a little more, it would be no less held."""
    x, dt = jnp.array([[0.0, 0.1], [0.0, 0.3]]), 0.02
    contacts = Contacts(
        Collisions((FLOOR,), pairs=[(0, 1)], radius=0.1), jnp.zeros(()), jnp.asarray(dt), x, jnp.ones(2), None
    )
    first = jnp.array([True, False])
    lands = Events(jnp.array([0, -1]), jnp.array([0.5, 0.0]), first, first)

    def bend(force):
        path = free_path(x, jnp.zeros_like(x).at[0, 1].set(-1e-3), jnp.zeros_like(x).at[0, 1].set(force * dt), dt)
        s = jnp.full(3, 0.5)
        return strike(contacts, path, lands, s, contacts.look(path, s), jnp.ones((2, 1))).bend[0, 1]

    for force in (0.0, -1.0):
        value, slope = jax.jvp(bend, (force,), (1.0,))
        np.testing.assert_allclose([value, slope], 0.0, atol=1e-15)


@pytest.mark.optimised
def test_what_a_step_holds_of_its_force_is_not_read_from_changes_within_rounding():
    x, v = jnp.array([[0.3, 0.1], [0.3, 0.3]]), jnp.zeros((2, 2))
    dv, dt = jnp.array([[1e-13, 0.0], [0.0, -0.3]]), 1 / 30
    displacement = dt * v + jnp.array([[1.0], [0.5]]) * dt * dv
    np.testing.assert_array_equal(share_of_the_force(x, displacement, v, dv, dt), [[0.5], [0.5]])
