"""Predicted stability limits against closed forms, and against the dt at which real runs blow up."""

import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import leapfrog_step, oscillator

import jeuler
from jeuler._core.precision import double_precision
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import implicit_euler_step, linearly_implicit_euler_step
from jeuler.steps.reduced import Runs, reduced_pair, symmetric_weights
from jeuler.steps.stability import DENSE, Linearisation, Spectrum, stability_limit


def decay(t, y, rate):
    return -rate * y


START = jnp.array(1.0), jnp.array(0.0)
KS = 25.0  # omega = 5 rad/s


@pytest.mark.filterwarnings("ignore:stability_limit")
@pytest.mark.parametrize(
    ("step", "damping_ratio", "expected"),
    [
        (jeuler.euler_step, 0.0, 0.0),
        (jeuler.heun_step, 0.0, 0.0),
        (jeuler.euler_step, 1e-3, 2e-3 / 5),
        (jeuler.euler_step, 0.3, 0.6 / 5),
        (jeuler.euler_step, 2.0, 2 / (5 * (2 + math.sqrt(3)))),
        (jeuler.symplectic_euler_step, 0.0, 2 / 5),
        (jeuler.symplectic_euler_step, 0.3, 2 * (math.sqrt(1 + 0.09) - 0.3) / 5),
        (jeuler.rk4_step, 0.0, math.sqrt(8) / 5),
        (implicit_euler_step, 0.0, math.inf),
        (linearly_implicit_euler_step, 0.3, math.inf),
    ],
)
def test_oscillator_has_the_closed_form_limit(step, damping_ratio, expected):
    limit = stability_limit(oscillator, 0.0, START, (KS, 10 * damping_ratio), step=step)
    assert limit == pytest.approx(expected, rel=1e-3)


@pytest.mark.filterwarnings("ignore:stability_limit")
@pytest.mark.parametrize("damping_ratio", [1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 3e-15, 1e-16, 0.0])
@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.heun_step, extrapolated_euler(2), jeuler.rk4_step])
def test_weak_damping_has_its_limit_however_slow_the_growth_above_it(step, damping_ratio):
    """Of Euler 2 zeta; of order two (8 zeta)^(1/3); of RK4 that on the imaginary axis."""
    exact = {1: 2 * damping_ratio, 2: (8 * damping_ratio) ** (1 / 3), 4: math.sqrt(8)}[step.order] / 5
    limit = stability_limit(oscillator, 0.0, START, (KS, 10 * damping_ratio), step=step)
    assert limit.lower <= 1.01 * exact
    assert 0.99 * exact <= limit.upper
    if damping_ratio >= 1e-13 or step.order == 4:
        assert limit == pytest.approx(exact, rel=0.01)
    slow = {1: 2e-5, 2: 1e-9, 4: -1}[step.order]
    if damping_ratio > 10 * slow:
        assert limit.known
        assert limit.reason == "all eigenvalues"
    if damping_ratio < slow / 10:
        assert limit.upper == pytest.approx({1: math.sqrt(2e-12), 2: 8e-12**0.25}[step.order] / 5, rel=0.1)
        assert "it is less than 1e-12 a step" in limit.reason or "cannot be told from roundoff" in limit.reason
        assert limit.known is (damping_ratio < 1e-14 and step.order == 1)  # growth of Euler shows at once


@pytest.mark.parametrize(
    ("step", "interval"),
    [
        (jeuler.euler_step, 2.0),
        (jeuler.heun_step, 2.0),
        (jeuler.rk4_step, 2.785293563),
        (extrapolated_euler(4), 2.785293563),
    ],
)
def test_decay_has_the_real_stability_interval(step, interval):
    assert stability_limit(decay, 0.0, 1.0, 50.0, step=step) == pytest.approx(interval / 50, rel=1e-6)


def spring_net(kd, side=3):
    index = np.arange(side * side).reshape(side, side)
    edges = np.concatenate(
        [np.stack([a.ravel(), b.ravel()], 1) for a, b in ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))]
    )
    position = np.stack(np.divmod(np.arange(side * side), side), axis=1).astype(float)
    position += 0.1 * np.sin(7 * position[:, ::-1])
    length = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1)
    mass = np.where(np.arange(side * side) == 0, np.inf, 0.5)
    scene = jeuler.Scene(forces=(jeuler.Springs(edges, ks=40.0, kd=kd, rest_length=length),))
    return scene, (jnp.asarray(position), jnp.zeros(position.shape)), jnp.asarray(mass)


def net_field(t, y, args):
    scene, mass = args
    return scene.vector_field(t, y, mass)


def linear(matrix):
    return lambda t, y, args: jnp.asarray(matrix) @ y


HEAT = 30 * (np.diag(-2 * np.ones(8)) + np.diag(np.ones(7), 1) + np.diag(np.ones(7), -1))
SPIRAL = np.array([[-1.0, 6.0], [-6.0, -1.0]])
UNEVEN = np.linspace(0.1, 2.0, 12)  # damping that couples the modes

net, rest, net_mass = spring_net(0.8)
uneven, _, _ = spring_net(UNEVEN)
PROBLEMS = [
    (decay, jnp.array(1.0), 50.0, jeuler.euler_step),
    (decay, jnp.array(1.0), 50.0, jeuler.heun_step),
    (decay, jnp.array(1.0), 50.0, jeuler.rk4_step),
    (oscillator, START, (KS, 3.0), jeuler.euler_step),
    (oscillator, START, (KS, 0.0), jeuler.symplectic_euler_step),
    (oscillator, START, (KS, 3.0), jeuler.symplectic_euler_step),
    (oscillator, START, (KS, 0.0), jeuler.rk4_step),
    (linear(HEAT), jnp.ones(8), None, jeuler.euler_step),
    (linear(HEAT), jnp.ones(8), None, extrapolated_euler(3)),
    (linear(SPIRAL), jnp.ones(2), None, jeuler.euler_step),
    (linear(SPIRAL), jnp.ones(2), None, jeuler.heun_step),
    (net_field, rest, (net, net_mass), jeuler.euler_step),
    (net_field, rest, (net, net_mass), jeuler.rk4_step),
    (net_field, rest, (net, net_mass), jeuler.symplectic_euler_step),
    (net_field, rest, (uneven, net_mass), jeuler.symplectic_euler_step),
]


@pytest.mark.parametrize("number", range(len(PROBLEMS)))
def test_runs_blow_up_within_five_percent_of_the_limit(number):
    """A perturbation of 1e-8 of the rest state stays as small at 0.95 of the limit, and grows at 1.05 of it."""
    f, y, args, step = PROBLEMS[number]
    limit = stability_limit(f, 0.0, y, args, step=step)
    leaves, tree = jax.tree.flatten(y)
    random = np.random.default_rng(number)
    small = jax.tree.unflatten(tree, [1e-8 * jnp.asarray(random.standard_normal(np.shape(leaf))) for leaf in leaves])
    rest = jax.tree.map(jnp.zeros_like, y)
    if f is net_field:  # start at rest: a net that can turn about its pin would drift away with a velocity
        rest, small = y, (small[0], jnp.zeros_like(small[1]))

    def size_after(dt):
        start = jax.tree.map(jnp.add, rest, small)
        run = jeuler.solve(f, start, dt=dt, num_steps=8000, args=args, step=step, save_every=8000)
        last = jax.tree.map(lambda leaf, r: leaf[-1] - r, run.y, rest)
        return float(max(jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(last)))

    assert size_after(0.95 * limit) < 1e-5
    assert not size_after(1.05 * limit) < 1e-3


def test_large_systems_agree_with_all_eigenvalues():
    n = DENSE + 88  # a chain in one dimension, by Arnoldi; its spectrum is known
    field = lambda t, y, ks: ks * (jnp.roll(y, 1).at[0].set(0) - 2 * y + jnp.roll(y, -1).at[-1].set(0))  # noqa: E731
    fastest = 4 * 9.0 * math.sin(n * math.pi / (2 * (n + 1))) ** 2
    assert stability_limit(field, 0.0, jnp.ones(n), 9.0) == pytest.approx(2 / fastest, rel=1e-4)


def test_a_long_heat_line_and_a_long_chain_have_the_closed_form_limit():
    heat = lambda t, y, args: jnp.diff(jnp.concatenate([y[:1], y, y[-1:]]), 2)  # noqa: E731
    assert stability_limit(heat, 0.0, jnp.zeros(1000)) == pytest.approx(0.5, rel=0.01)
    n = 600
    chain = np.stack([np.arange(n - 1), np.arange(1, n)], 1)
    scene = jeuler.Scene((jeuler.Springs(chain, ks=100.0, kd=0.0, rest_length=1.0),))
    state = jeuler.ParticleState(jnp.arange(n, dtype=float)[:, None], jnp.zeros((n, 1)))
    limit = stability_limit(scene, state, step=jeuler.symplectic_euler_step)
    assert limit == pytest.approx(0.1, rel=0.01)
    assert limit.known
    assert limit.lower < limit < limit.upper < 1.04 * limit.lower
    assert stability_limit(scene, state) == 0.0  # undamped


def random_net(seed, kd=None):
    random = np.random.default_rng(seed)
    count, dim = 5, 2 + seed % 2
    x = random.normal(size=(count, dim))
    edges = [(i, j) for i in range(count) for j in range(i) if j == i - 1 or random.random() < 0.4]
    length = np.array([np.linalg.norm(x[i] - x[j]) for i, j in edges]) * (1 - 0.05 * random.random(len(edges)))
    mass = 10 ** random.uniform(-0.5, 0.5, count)
    mass[0] = np.inf
    kd = 10 ** random.uniform(-2, 0.5, len(edges)) if kd is None else kd
    scene = jeuler.Scene((jeuler.Springs(edges, ks=10 ** random.uniform(0, 2, len(edges)), kd=kd, rest_length=length),))
    return scene, jeuler.ParticleState(jnp.asarray(x), jnp.zeros(x.shape), jnp.asarray(mass))


def stretched_net(seed):
    """Six particles in space, its springs up to 1 % short."""
    random = np.random.default_rng(seed)
    x = random.normal(size=(6, 3))
    edges = [(i, j) for i in range(6) for j in range(i) if j == i - 1 or random.random() < 0.4]
    length = np.array([np.linalg.norm(x[i] - x[j]) for i, j in edges]) * (1 - 0.01 * random.random(len(edges)))
    mass = random.uniform(0.5, 2.0, 6)
    mass[0] = np.inf
    scene = jeuler.Scene((jeuler.Springs(edges, ks=10.0, kd=0.5, rest_length=length),))
    return scene, jeuler.ParticleState(jnp.asarray(x), jnp.zeros(x.shape), jnp.asarray(mass))


def test_a_stretched_net_is_stable_in_long_runs_up_to_its_limit():
    """What 2^20 steps make of a perturbation, by the forces written out here: no growth at 0.36, growth at 0.37."""
    scene, state = stretched_net(2)
    springs, mass = scene.forces[0], np.asarray(state.mass)[:, None]
    i, j = np.asarray(springs.edges).T
    length = np.asarray(springs.rest_length)[:, None]

    def acceleration(x, v):
        along, speed = x[j] - x[i], v[j] - v[i]
        size = jnp.linalg.norm(along, axis=1, keepdims=True)
        unit = along / size
        pull = (10.0 * (size - length) + 0.5 * jnp.sum(speed * unit, axis=1, keepdims=True)) * unit
        return jnp.zeros_like(x).at[i].add(pull).at[j].add(-pull) / mass

    by_x, by_v = (np.reshape(jax.jacfwd(acceleration, k)(state.position, state.velocity), (18, 18)) for k in (0, 1))

    def after_many_steps(dt):
        to_v = np.hstack([dt * by_x, np.eye(18) + dt * by_v])
        step = np.vstack([np.hstack([np.eye(18), np.zeros((18, 18))]) + dt * to_v, to_v])
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(np.linalg.matrix_power(step, 2**20))

    assert after_many_steps(0.36) < 1e8  # a drift
    assert not after_many_steps(0.37) < 1e100
    assert 0.36 < stability_limit(scene, state, step=jeuler.symplectic_euler_step) < 0.37


@pytest.mark.parametrize("seed", range(6))
def test_prestressed_nets_of_unequal_masses_under_symplectic_euler(seed):
    """For symmetric K and C >= 0 it is stable exactly as long as dt^2 K + 2 dt C < 4, in units of mass."""
    scene, state = random_net(seed, kd=0.0 if seed % 3 == 0 else None)
    size = state.position.size
    weight = np.sqrt(np.repeat(np.where(np.isfinite(state.mass), state.mass, 1), state.position.shape[1]))

    def acceleration(x, v):
        shape = state.position.shape
        return scene.vector_field(0.0, (x.reshape(shape), v.reshape(shape)), state.mass)[1].ravel()

    at_rest = state.position.ravel(), state.velocity.ravel()
    stiffness, damping = (-weight[:, None] * np.asarray(jax.jacfwd(acceleration, k)(*at_rest)) / weight for k in (0, 1))
    free = np.repeat(np.isfinite(state.mass), size // len(state.mass))
    stiffness, damping = (matrix[np.ix_(free, free)] for matrix in (stiffness, damping))

    def stable(dt):
        return np.linalg.eigvalsh(dt**2 * stiffness + 2 * dt * damping).max() < 4

    low, high = 1e-4, 10.0
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    limit = stability_limit(scene, state, step=jeuler.symplectic_euler_step)
    assert limit == pytest.approx(low, rel=1e-3)


@pytest.mark.parametrize("step", [jeuler.symplectic_euler_step, jeuler.rk4_step, leapfrog_step])
def test_a_net_in_a_part_of_its_space_has_the_limit_of_the_whole(step):
    """The large path on a net that the small one can do too."""
    scene, state = random_net(7)
    y, args = scene.as_equation(state)
    whole = stability_limit(scene, state, step=step)
    with double_precision():
        linear = Linearisation(scene.vector_field, y, args)
        flat = np.asarray(linear.flat)
        product = lambda u: np.asarray(linear.product(0.0, flat, jnp.asarray(u)))  # noqa: E731
        small = reduced_pair(product, flat.size, symmetric_weights(product, flat.size, args.mass))
        part = linear.limit_of(Spectrum.of(small.matrix, small.like, linear.neutral), step, "unstable")
        checked = linear.bisected(lambda dt: dt > whole, Runs(linear.field, step, linear.y, 1.0), part, 10.0)
    k = len(small.matrix) // 2
    for block in (small.matrix[k:, :k], small.matrix[k:, k:]):  # also beside a pinned particle and unequal masses
        np.testing.assert_allclose(block, block.T, atol=1e-9 * np.abs(block).max())
    assert part == pytest.approx(whole, rel=1e-3)
    assert checked == pytest.approx(whole, rel=0.02)


def test_a_limit_that_runs_cannot_confirm_says_so():
    """Damping of one mode in a thousand: growth at 1.5 % above the limit would take a million steps to show."""
    n = 800
    omega = jnp.linspace(1.0, 2.0, n)
    field = lambda t, y, args: (y[1], -(omega**2) * y[0] - 2e-3 * omega * y[1])  # noqa: E731
    with pytest.warns(UserWarning, match="not known within 2 %"):
        limit = stability_limit(field, 0.0, (jnp.zeros(n), jnp.zeros(n)))
    assert not limit.known
    assert limit.lower <= limit <= limit.upper
    assert limit == pytest.approx(1e-3, rel=0.02)  # that of the fastest mode all the same


def test_growth_by_nature_has_a_decaying_twin_that_no_step_is_to_blame_for():
    field = lambda t, y, args: (y[1], jnp.array([4.0, -100.0]) * y[0])  # noqa: E731
    y = jnp.array([1e-3, 1.0]), jnp.zeros(2)
    step = jeuler.symplectic_euler_step
    assert stability_limit(field, 0.0, y, step=step, growing="skip") == pytest.approx(0.2, rel=1e-3)
    assert stability_limit(field, 0.0, y, step=step) == 0.0


def test_a_scene_and_its_state_stand_for_field_and_arguments():
    scene, state = random_net(3)
    expected = stability_limit(scene.vector_field, 0.5, (state.position, state.velocity), state.mass)
    assert stability_limit(scene, state) == stability_limit(scene, 0.5, state) == expected > 0
    with pytest.raises(ValueError, match="state must be a ParticleState"):
        stability_limit(scene, 0.0, (state.position, state.velocity))
    with pytest.raises(ValueError, match="y must be the state at time t"):
        stability_limit(scene.vector_field, 0.0)


def test_a_limit_is_a_float_that_survives_copies():
    limit = stability_limit(decay, 0.0, 1.0, 50.0)
    again = pickle.loads(pickle.dumps(limit))
    assert isinstance(limit, float)
    assert (again, again.known, again.reason) == (limit, True, "all eigenvalues")


def test_growth_of_the_equation_is_unstable_or_left_out():
    grow = lambda t, y, args: jnp.array([1.0, -10.0]) * y  # noqa: E731
    assert stability_limit(grow, 0.0, jnp.ones(2)) == 0.0
    assert stability_limit(grow, 0.0, jnp.ones(2), growing="skip") == pytest.approx(0.2)


def test_a_system_that_only_drifts_is_stable_at_any_step():
    drift = lambda t, y, args: (y[1], jnp.zeros(2))  # noqa: E731
    assert stability_limit(drift, 0.0, (jnp.zeros(2), jnp.ones(2))) == math.inf


def test_a_step_of_ones_own_and_complex_states():
    assert stability_limit(oscillator, 0.0, START, (KS, 0.0), step=leapfrog_step) == pytest.approx(0.4, rel=1e-3)
    spiral = lambda t, y, args: (-1 + 6j) * y  # noqa: E731
    assert stability_limit(spiral, 0.0, 1.0 + 0j) == pytest.approx(2 / 37, rel=1e-6)


def test_float32_data_have_the_same_limit():
    y = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), rest)
    expected = stability_limit(net_field, 0.0, rest, (net, net_mass))
    assert stability_limit(net_field, 0.0, y, (net, net_mass), growing="skip") == pytest.approx(expected, rel=1e-3)


def test_bad_input_is_told():
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda y: stability_limit(decay, 0.0, y, 1.0))(1.0)
    with pytest.raises(ValueError, match="must be finite"):
        stability_limit(lambda t, y, args: jnp.sqrt(y), 0.0, 0.0)
    with pytest.raises(ValueError, match='"unstable" or "skip"'):
        stability_limit(decay, 0.0, 1.0, 1.0, growing="maybe")
