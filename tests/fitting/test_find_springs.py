"""Springs from tracks alone: against nets whose springs are known, made by an accurate solver."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jeuler

CORNERS = np.array([[0, 0], [1, 0], [1.1, 1], [0, 0.9], [2, 0.5], [2.2, 1.6], [-0.9, 0.4]], float)
EDGES = np.array([[0, 1], [0, 3], [0, 6], [1, 2], [1, 4], [2, 3], [2, 4], [4, 5]])
KS = np.array([20, 30, 1.0, 25, 40, 35, 20, 28])
KD = 0.1
TIMES = np.linspace(0, 8, 401)


def tracks(position, velocity, edges, ks, kd, rest_length, mass, times=TIMES, gravity=0.0):
    """Positions at the times, by SciPy's method of eighth order."""
    count, dim = position.shape
    i, j = edges.T

    def slope(t, y):
        x, v = y.reshape(2, count, dim)
        d, dv = x[i] - x[j], v[i] - v[j]
        r = np.linalg.norm(d, axis=1)[:, None]
        u = d / np.where(r > 0, r, 1)
        pull = -ks[:, None] * d + (ks * rest_length)[:, None] * u - kd * np.sum(dv * u, 1, keepdims=True) * u
        force = np.zeros_like(x)
        np.add.at(force, i, pull)
        np.add.at(force, j, -pull)
        a = np.where(np.isinf(mass)[:, None], 0, force / mass[:, None] - gravity * np.eye(dim)[-1])
        return np.concatenate([v.ravel(), a.ravel()])

    start = np.concatenate([position.ravel(), velocity.ravel()])
    y = solve_ivp(slope, times[[0, -1]], start, t_eval=times, rtol=1e-10, atol=1e-10, method="DOP853").y
    return y[: count * dim].T.reshape(-1, count, dim)


@pytest.fixture(scope="module")
def net():
    lengths = np.linalg.norm(CORNERS[EDGES[:, 0]] - CORNERS[EDGES[:, 1]], axis=1) * 0.97
    velocity = 0.4 * np.random.default_rng(5).normal(size=CORNERS.shape)
    return tracks(CORNERS, velocity, EDGES, KS, KD, lengths, np.ones(7)), lengths


@pytest.mark.parametrize("noise", [0, 1e-3, 1e-2], ids=["exact", "0.1 %", "1 %"])
def test_all_springs_of_a_net_and_none_else(net, noise):
    positions, lengths = net
    seen = positions + noise * np.std(positions - positions.mean(0)) * np.random.default_rng(6).normal(
        size=positions.shape
    )
    found = jeuler.find_springs(TIMES, seen, mass=1.0, refine=False)
    assert found.edges.tolist() == EDGES.tolist()
    assert found.explained
    for name, value in (("ks", KS), ("rest_length", lengths)):
        error = np.abs(getattr(found, name) - value)
        assert (error < 4 * found.stderr[name] + 1e-3 * value).all(), name
    assert len(found.hidden) == 0


def test_gaps_pinned_particles_gravity_and_uneven_times():
    mass = np.array([np.inf, 0.5, 0.4, 0.6])
    position = np.array([[0, 0], [0.9, 0.1], [1.7, 0.5], [2.3, 1.1]], float)
    edges, ks, lengths = np.array([[0, 1], [1, 2], [2, 3]]), np.array([60.0, 40.0, 50.0]), np.array([0.8, 0.8, 0.8])
    times = 0.01 * np.arange(601) + np.random.default_rng(1).uniform(0, 0.004, 601)
    seen = tracks(position, np.zeros((4, 2)), edges, ks, 0.2, lengths, mass, times, gravity=9.81)
    seen = seen + 2e-4 * np.random.default_rng(2).normal(size=seen.shape)
    seen[200:240, 2], seen[:, 0] = np.nan, np.nan
    seen[0, 0] = 0.0  # the pinned one was measured once
    found = jeuler.find_springs(times, seen, mass=mass, forces=(jeuler.Gravity([0.0, -9.81]),), refine=False)
    assert found.edges.tolist() == edges.tolist()
    np.testing.assert_allclose(found.ks, ks, rtol=0.02)
    np.testing.assert_allclose(found.rest_length, lengths, rtol=0.01)


def test_springs_of_rest_length_zero():
    """The setting of T. Kipf et al., Neural relational inference, 2018: F = -0.1 (x_i - x_j)."""
    draw = np.random.default_rng(0)
    times, pairs = 0.1 * np.arange(49), np.stack(np.triu_indices(5, 1), axis=1)
    for _ in range(5):
        edges = pairs[draw.random(len(pairs)) < 0.5]
        velocity = draw.normal(size=(5, 2))
        velocity *= 0.5 / np.linalg.norm(velocity, axis=1, keepdims=True)
        zero = np.zeros(len(edges))
        seen = tracks(draw.normal(size=(5, 2)) * 0.5, velocity, edges, zero + 0.1, 0.0, zero, np.ones(5), times)
        found = jeuler.find_springs(times, seen, mass=1.0, refine=False)
        assert found.edges.tolist() == edges.tolist()
        np.testing.assert_allclose(found.ks, 0.1, rtol=1e-3)
        assert (found.rest_length < 1e-3).all()


@pytest.mark.parametrize("seed", [106, 219])
def test_errors_of_the_integrals_are_no_spring(seed):
    """Two runs of that setting with 10 balls by its leapfrog, in which they looked like one of 2e-5 N/m."""
    draw, pairs = np.random.default_rng(seed), np.stack(np.triu_indices(10, 1), axis=1)
    edges = pairs[draw.random(45) < 0.5]
    velocity = draw.normal(size=(10, 2))
    velocity *= 0.5 / np.linalg.norm(velocity, axis=1, keepdims=True)
    x, ends, dt = 0.5 * draw.normal(size=(10, 2)), np.eye(10)[edges[:, 0]] - np.eye(10)[edges[:, 1]], 0.001
    matrix = -0.1 * ends.T @ ends
    velocity, seen = velocity + dt / 2 * matrix @ x, [x]
    for n in range(1, 4801):
        x = x + dt * velocity
        velocity = velocity + dt * matrix @ x
        seen += [x] if n % 100 == 0 else []
    found = jeuler.find_springs(0.1 * np.arange(49), np.array(seen), mass=1.0, refine=False)
    assert found.edges.tolist() == edges.tolist()


def test_a_hidden_particle_gives_a_word(net):
    found = jeuler.find_springs(TIMES, net[0][:, [0, 2, 3, 4, 5, 6]], mass=1.0)
    assert not found.explained
    assert "not tracked" in found.message
    assert found.fit is None


def test_a_force_that_was_not_given_gives_a_word(net):
    falling = net[0] - np.array([0, 0.5 * 9.81]) * TIMES[:, None, None] ** 2
    assert not jeuler.find_springs(TIMES, falling, mass=1.0, refine=False).explained
    told = jeuler.find_springs(TIMES, falling, mass=1.0, refine=False, forces=(jeuler.Gravity([0.0, -9.81]),))
    assert told.explained
    assert told.edges.tolist() == EDGES.tolist()


def test_what_is_not_excited_is_named():
    """Two pairs, far apart: one swings, the other only drifts, and nothing changes its length."""
    t = np.linspace(0, 6, 201)
    swing = 0.5 + 0.1 * np.cos(np.sqrt(2 * 10.0) * t)
    seen = np.stack([-swing, swing, 8 + 0.1 * t, 9 + 0.1 * t], axis=1)[:, :, None]
    seen = seen + 1e-4 * np.random.default_rng(0).normal(size=seen.shape)
    found = jeuler.find_springs(t, seen, mass=1.0, refine=False)
    assert found.edges.tolist() == [[0, 1]]
    assert [2, 3] in found.hidden.tolist()
    assert "does not excite" in found.message


def test_noise_alone_makes_no_springs():
    draw, false = np.random.default_rng(3), 0
    t = np.linspace(0, 1, 101)
    for _ in range(10):
        start, speed = draw.normal(size=(2, 6, 2))
        seen = start + speed * t[:, None, None] + 1e-3 * draw.normal(size=(101, 6, 2))
        false += len(jeuler.find_springs(t, seen, mass=1.0, refine=False).edges)
    assert false <= 1


def test_the_fit_of_the_whole_motion_refines(net):
    """A part of the net, so that it is quick."""
    position, edges = CORNERS[[0, 1, 3]], np.array([[0, 1], [0, 2]])
    velocity = 0.4 * np.random.default_rng(5).normal(size=(3, 2))
    ks = np.array([20.0, 30.0])
    t = TIMES[:201]
    seen = tracks(position, velocity, edges, ks, KD, np.array([0.9, 0.8]), np.ones(3), t)
    seen = seen + 2e-3 * np.random.default_rng(6).normal(size=seen.shape)
    found = jeuler.find_springs(t, seen, mass=1.0)
    assert found.edges.tolist() == edges.tolist()
    assert found.fit is not None
    assert found.fit.noise_ratio < 1.1
    assert (np.abs(found.ks - ks) < 4 * found.stderr["ks"]).all()
    assert (found.stderr["ks"] < 0.5).all()


@pytest.mark.parametrize(("noise", "said"), [(1e-3, False), (0.02, True)])
def test_noise_beside_which_a_spring_hardly_changes_its_length_is_said(noise, said):
    t = np.linspace(0, 6, 201)
    swing = 0.5 + 0.05 * np.cos(np.sqrt(2 * 10.0) * t)
    seen = np.stack([-swing, swing], axis=1)[:, :, None]
    seen = seen + noise * np.random.default_rng(0).normal(size=seen.shape)
    found = jeuler.find_springs(t, seen, mass=1.0, refine=False)
    assert found.edges.tolist() == [[0, 1]]
    assert ("may be too low" in found.message) == said


@pytest.mark.parametrize("noise", [1e-3, 1e-2], ids=["0.1 %", "1 %"])
@pytest.mark.parametrize(("samples", "followed"), [(6.3, True), (4.8, True), (3.1, False)])
def test_few_samples_a_period_give_honest_errors_or_a_word(samples, followed, noise):
    """Of the swing of the stiffest pair. The covariance of the accelerations alone is 6 standard errors off at 4.8."""
    position, edges = CORNERS[:3], np.array([[0, 1], [1, 2]])
    ks, lengths = np.array([300.0, 200.0]), np.linalg.norm(np.diff(CORNERS[:3], axis=0), axis=1)
    times = 2 * np.pi / np.sqrt(600.0) / samples * np.arange(81)
    velocity = np.random.default_rng(1).normal(size=(3, 2))
    seen = tracks(position, velocity, edges, ks, KD, lengths, np.ones(3), times)
    seen = seen + 0.08 * noise * np.random.default_rng(2).normal(size=seen.shape)
    found = jeuler.find_springs(times, seen, mass=1.0, refine=False)
    assert found.explained == followed
    assert ("is not followed" in found.message) != followed
    if followed:
        assert found.edges.tolist() == edges.tolist()
        assert (np.abs(found.ks - ks) < 3 * found.stderr["ks"]).all()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"mass": 0.0}, "mass must be above 0"),
        ({"mass": [1.0, 2.0]}, r"mass must be one number or have shape \(7,\)"),
        ({"mass": np.inf}, "mass must be finite for the particles that can move"),
        ({"candidates": [[0, 7]]}, "candidates must be indices of particles from 0 to 6"),
        ({"candidates": [[1, 1]]}, "candidates must be different particles"),
        ({"candidates": [0, 1]}, "candidates must have shape"),
        ({"forces": 1.0}, "forces must be a tuple"),
        ({"sigma": 0.0}, "sigma"),
        ({"false_positives": 2.0}, "false_positives must be a chance"),
        ({"refine": 1}, "refine"),
        ({"positions": np.zeros((401, 7))}, "positions must have shape"),
        ({"positions": np.ones((401, 7, 2))}, "positions must show a motion"),
        ({"positions": np.zeros((401, 7, 2)) + np.arange(7.0)[:, None]}, "positions must show a motion"),
        ({"times": TIMES[:8], "positions": np.ones((8, 7, 2))}, "times must be 9 or more"),
    ],
)
def test_wrong_input_is_one_line(net, change, expected):
    call = {"times": TIMES, "positions": net[0], "mass": 1.0} | change
    with pytest.raises(ValueError, match=expected) as error:
        jeuler.find_springs(call.pop("times"), call.pop("positions"), **call)
    assert "\n" not in str(error.value)


def test_where_accelerations_leave_a_choice_the_whole_motion_makes_it():
    """The setting of Neural Relational Inference, 10 balls, noise 0.01, by the closed form: 5 runs of 45 pairs.

    The accelerations alone have 94 of 100 pairs right there; without noise all are.
    """
    pairs, times, wrong = np.stack(np.triu_indices(10, 1), axis=1), 0.1 * np.arange(49), 0
    said = 0
    for seed in range(5):
        draw = np.random.default_rng(seed)
        true = draw.random(45) < 0.5
        ends = np.zeros((45, 10))
        ends[np.arange(45), pairs[:, 0]], ends[np.arange(45), pairs[:, 1]] = 1, -1
        squares, modes = np.linalg.eigh(0.1 * ends[true].T @ ends[true])
        omega = np.sqrt(np.maximum(squares, 1e-12))
        place, speed = (0.5 * modes.T @ draw.normal(size=(10, 2)) for _ in range(2))
        phase = np.outer(times, omega)[:, :, None]
        x = np.einsum("ak,tkd->tad", modes, np.cos(phase) * place + np.sin(phase) / omega[:, None] * speed)
        for noise in (0.0, 0.01)[seed > 0 :]:
            found = jeuler.find_springs(times, x + noise * draw.normal(size=x.shape), mass=1.0, refine=False)
            got = np.isin(10 * pairs[:, 0] + pairs[:, 1], 10 * found.edges[:, 0] + found.edges[:, 1])
            wrong += np.sum(got != true)
            said += "the whole motion made it" in found.message
            assert noise or not (wrong or said)
    assert said
    assert wrong <= 0.04 * 5 * 45
