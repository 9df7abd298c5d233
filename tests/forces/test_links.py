"""Links with a law of their own, and the angle of torsion, against formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import NET_EDGES, net_state

import jeuler
from jeuler import BreakableSprings, Breaking, CubicSprings, Scene, Springs, Strings, Torsion


def test_cubic_springs_and_strings_are_springs_where_they_should_be():
    state = net_state()
    here = 0.0, state.position, state.velocity, state.mass
    plain = Springs(NET_EDGES, 30.0, 0.7, 0.2)
    np.testing.assert_allclose(CubicSprings(NET_EDGES, 30.0, 0.7, 0.2, cubic=0.0)(*here), plain(*here), rtol=1e-12)
    np.testing.assert_allclose(Strings(NET_EDGES, 30.0, 0.7, 0.2)(*here), plain(*here), rtol=1e-12, err_msg="all taut")
    assert not Strings(NET_EDGES, 30.0, 0.7, 9.0)(*here).any(), "all slack"
    one = CubicSprings([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0, cubic=4.0)
    x = jnp.array([[0.0], [1.5]])
    slope = jax.grad(lambda x: one.energy(0.0, x, 1.0))(x)
    np.testing.assert_allclose(one(0.0, x, 0 * x, jnp.ones(2)), -slope)
    np.testing.assert_allclose(slope[1, 0], 10 * 0.5 + 4 * 0.5**3)


def test_a_string_does_not_push_however_it_is_damped():
    string = Strings([[0, 1]], ks=10.0, kd=100.0, rest_length=1.0)
    x, v = jnp.array([[0.0], [1.5]]), jnp.array([[0.0], [-3.0]])
    assert not string(0.0, x, v, jnp.ones(2)).any()
    coincident = jax.jacobian(lambda x: string(0.0, x, 0 * x, jnp.ones(2)))(jnp.zeros((2, 1)))
    assert np.isfinite(coincident).all()


def test_what_is_broken_stays_broken_and_is_counted():
    """A weight thrown up and down: the first string breaks at the strain it was given, the second holds."""
    net = BreakableSprings([[0, 1], [0, 2]], ks=50.0, kd=0.0, rest_length=1.0)
    state = jeuler.ParticleState([[0.0], [1.0], [-1.0]], [[0.0], [4.0], [-1.0]], mass=[jnp.inf, 1.0, 1.0])
    scene = Scene((net,), (Breaking(net, max_strain=0.3),))
    run = jeuler.simulate(scene, state, dt=1e-2, num_steps=60, step=jeuler.symplectic_euler_step).y
    first = int(np.argmax(run.broken_springs))
    assert run.position[first - 1, 1, 0] <= 1.3 < run.position[first, 1, 0]
    assert run.broken_springs[first:].tolist() == [1] * (61 - first)
    assert run.broken[-1, 0].tolist() == [True, False]
    np.testing.assert_array_equal(np.diff(run.velocity[first:, 1, 0]), 0, err_msg="nothing pulls any more")
    with pytest.raises(ValueError, match="BreakableSprings"):
        Breaking(Springs([[0, 1]], 1.0, 0.0, 1.0), 0.5)


def test_torsion_has_the_dihedral_angle_and_no_jump_where_it_wraps():
    def fold(angle):
        return jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, jnp.cos(angle), jnp.sin(angle)]])

    for rest in (0.4, np.pi):
        energy = jax.jit(lambda angle, rest=rest: Torsion([[0, 1, 2, 3]], 2.0, rest).energy(0.0, fold(angle), 1.0))
        for angle in (0.0, 0.4, 1.9, np.pi - 1e-3, np.pi + 1e-3):
            off = (angle - rest + np.pi) % (2 * np.pi) - np.pi
            np.testing.assert_allclose(energy(angle), off**2, atol=1e-10)
    straight = jnp.arange(4.0)[:, None] * jnp.array([1.0, 0.0, 0.0])
    assert not Torsion([[0, 1, 2, 3]], 2.0)(0.0, straight, 0 * straight, jnp.ones(4)).any()
    state = jeuler.ParticleState(jnp.zeros((4, 2)), jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match="dim = 3"):
        jeuler.simulate(Scene((Torsion([[0, 1, 2, 3]], 2.0),)), state, dt=0.1, num_steps=1)


@pytest.mark.parametrize("kind", [jeuler.Springs, jeuler.CubicSprings, jeuler.Strings, jeuler.BreakableSprings])
def test_links_in_periodic_space_are_those_to_the_nearest_image(kind, random):
    """A net of offsets and chance across the borders: whole boxes away, each particle feels the same as in free space."""
    n, box = 40, np.array([3.0, 4.0])
    x, v = np.cumsum(random.uniform(-0.6, 0.6, (2, n, 2)), axis=1)
    edges = np.array([(k, k + 1) for k in range(n - 1)] + [(0, 2), (7, 5)])
    laws = {"ks": random.uniform(1, 2, len(edges)), "kd": 0.3, "rest_length": 0.5}
    laws |= {"cubic": 2.0} if kind is jeuler.CubicSprings else {}
    broken = (jnp.arange(len(edges))[None] == 3,) if kind is jeuler.BreakableSprings else ()
    folded = x + box * random.integers(-2, 3, (n, 2))
    rest = 0.0, jnp.asarray(v), jnp.ones(()), *broken

    def force(links, x):
        return links(rest[0], jnp.asarray(x), *rest[1:])

    links, free = kind(edges, **laws, box=box), kind(edges, **laws)
    np.testing.assert_allclose(force(links, folded), force(free, x), atol=1e-12)
    np.testing.assert_allclose(jnp.sum(force(links, folded), axis=0), 0, atol=1e-12)
    assert not np.allclose(force(free, folded), force(free, x)), "the test would see the box ignored"
    if hasattr(links, "energy"):
        at = jnp.asarray(folded), jnp.ones(())
        np.testing.assert_allclose(links.energy(0.0, *at), free.energy(0.0, jnp.asarray(x), at[1]), rtol=1e-12)

        def energy(scale):
            return kind(edges, **laws, box=box * scale).energy(0.0, *at)

        slope = (energy(1 + 1e-6) - energy(1 - 1e-6)) / 2e-6
        np.testing.assert_allclose(jax.grad(energy)(1.0), slope, rtol=1e-6)
    with pytest.raises(ValueError, match=r"box must have shape \(2,\)"):
        kind(edges, **laws, box=[1.0]).check(n, 2)
