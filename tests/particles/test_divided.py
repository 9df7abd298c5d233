"""One scene over several devices: equal to the undivided run, what is sent is the halo, what cannot be is refused."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from eight_devices import printed_by

import jeuler
from jeuler._core.indices import Indices
from jeuler.graphs.partition import partition
from jeuler.scenes.shapes import square_cloth


def test_a_divided_run_equals_the_undivided_one_sends_its_halo_and_goes_on_from_a_folder(tmp_path):
    assert len(printed_by(Path(__file__).with_name("on_devices.py"), tmp_path)) == 6


def some_groups(kind, rng):
    pairs = {
        "random": rng.integers(0, 40, (60, 2)),
        "star": np.stack([np.zeros(39, int), np.arange(1, 40)], axis=1),
        "one pair": np.array([[0, 39]]),
        "none": np.zeros((0, 2), int),
    }[kind]
    return pairs[pairs[:, 0] != pairs[:, 1]] if len(pairs) else pairs


@pytest.mark.parametrize("strips", [1, 3, 8, 40, 64])
@pytest.mark.parametrize("kind", ["random", "star", "one pair", "none"])
def test_each_strip_has_all_groups_of_its_particles_and_gets_the_ghosts_of_these(kind, strips):
    pairs = some_groups(kind, np.random.default_rng(0))
    parts = partition((Indices(pairs), Indices(np.array([[1, 2, 3], [20, 39, 0]]))), 40, strips)
    order = np.arange(40) if parts.order is None else parts.order
    padded = np.full(strips * parts.size, -1)
    padded[:40] = order
    own = padded.reshape(strips, parts.size)
    assert sorted(order) == list(range(40))
    ghosts = [np.zeros((strips, 0), int)]
    for hop, rows in zip(parts.hops, parts.sends, strict=True):
        got = np.full((strips, rows.shape[1]), -2)
        for p in range(strips):
            if 0 <= p + hop < strips:
                got[p + hop] = own[p][rows[p]]
        ghosts.append(got)
    local = np.concatenate([own, *ghosts], axis=1)
    for groups, which, rows, targets in zip(
        (pairs, np.array([[1, 2, 3], [20, 39, 0]])), parts.which, parts.rows, parts.targets, strict=True
    ):
        counted = np.zeros(groups.shape, int)
        for p in range(strips):
            real = (targets[p] < parts.size).any(axis=0)
            assert np.array_equal(local[p][rows[p]].T[real], groups[which[p]][real])
            for member, target in zip(which[p][real], targets[p].T[real], strict=True):
                mine = np.isin(groups[member], own[p])
                assert np.array_equal(target < parts.size, mine)
                assert np.array_equal(own[p][target[mine]], groups[member][mine])
                counted[member] += mine
        assert np.all(counted == 1)  # each end of each group gets its force once


def test_a_cloth_sends_two_rows_of_particles_over_each_border():
    cloth = square_cloth(64, 1.0)
    state = jeuler.ParticleState(cloth.position, 0 * cloth.position)
    scene = jeuler.Scene((jeuler.Springs(cloth.edges, 1.0, 0.1, cloth.length), jeuler.Bending(cloth.lines, 1.0)))
    division = jeuler.divide(scene, state, devices=8)
    itemsize = state.position.dtype.itemsize
    assert division.bytes_sent == 2 * 64 * 7 * 2 * 2 * 3 * itemsize  # rows, borders, directions, x and v, dim
    assert str(division).startswith("8 devices of 512 particles and at most 256 ghosts, 14 messages of ")
    shuffled = np.random.default_rng(0).permutation(len(cloth.position))
    scene = jeuler.Scene((jeuler.Springs(shuffled[cloth.edges], 1.0, 0.1, cloth.length),))
    assert jeuler.divide(scene, state, devices=8).bytes_sent < 3 * division.bytes_sent  # the order is found again


PAIR = jeuler.ParticleState(jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.zeros((2, 2)))
SPRING = jeuler.Springs([[0, 1]], 1.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("forces", "effects", "state", "how", "message"),
    [
        ((lambda t, x, v, m: 0 * x,), (), PAIR, {}, "mesh must be None with <lambda>, which may act on any particles"),
        ((jeuler.AppliedForce(jnp.zeros(2)),), (), PAIR, {}, "mesh must be None with AppliedForce"),
        ((), (jeuler.SpeedLimit(1.0),), PAIR, {}, "mesh must be None with SpeedLimit"),
        ((), (jeuler.Collisions(pairs=[(0, 1)]),), PAIR, {}, "mesh must be None with Collisions of pairs"),
        ((jeuler.Springs([[0, 1]], lambda t: t * jnp.ones(1), 0.0, 1.0),), (), PAIR, {}, "Springs.ks that is a function"),
        ((SPRING,), (), PAIR.replace(alive=jnp.ones(2, bool)), {}, "mesh must be None with state.alive"),
        ((SPRING,), (), PAIR.replace(heat=jnp.ones(2)), {}, "mesh must be None with state.heat"),
        ((SPRING,), (), PAIR, {"step": jeuler.implicit_euler_step}, "step must be explicit with mesh"),
        ((SPRING,), (), PAIR, {"checkpoint": "reversible"}, 'checkpoint must not be "reversible" with mesh'),
        ((SPRING,), (), PAIR, {"windows": "auto"}, "windows must not be given with mesh"),
        ((SPRING,), (), PAIR, {"mesh": 8}, "mesh must be a jax.sharding.Mesh, got 8"),
    ],
)  # fmt: skip
def test_what_cannot_be_divided_is_refused_before_tracing(forces, effects, state, how, message):
    how = {"mesh": jax.make_mesh((1,), ("device",)), **how}
    with pytest.raises(ValueError, match=message):
        jeuler.simulate(jeuler.Scene(forces, effects), state, dt=0.1, num_steps=1, **how)


def test_a_divided_run_shows_how_far_it_is():
    told = []
    how = {"dt": 0.1, "num_steps": 4, "mesh": jax.make_mesh((1,), ("device",))}
    run = jeuler.simulate(jeuler.Scene((SPRING,)), PAIR, **how, progress=lambda *so_far: told.append(so_far))
    np.testing.assert_array_equal(run.y.position, jeuler.simulate(jeuler.Scene((SPRING,)), PAIR, **how).y.position)
    assert told[-1] == (4, 4)
