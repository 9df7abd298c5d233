"""The kernels of springs: every layout is the same linear map, with the same derivatives, as the plain
formula."""

import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jeuler
from jeuler.graphs import layouts, topology
from jeuler.graphs.layouts import Pairs, Rows, Shifts
from jeuler.graphs.topology import Topology

PARTICLES = 30


@pytest.fixture(scope="module", autouse=True)
def rows_for_small_graphs():
    """So that graphs of 40 edges get the layout of 500."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(topology, "MANY", 40)
        topology._layouts.cache_clear()
        yield
    topology._layouts.cache_clear()


def lattice(particles=PARTICLES, offsets=(1, 6)):
    return np.concatenate([np.stack([np.arange(particles - k), np.arange(k, particles)], 1) for k in offsets])


def random_edges(rng, count, particles=PARTICLES):
    i = rng.integers(0, particles, count)
    return np.stack([i, (i + rng.integers(1, particles, count)) % particles], axis=1)


def graphs():
    rng = np.random.default_rng(1)
    regular = rng.permutation(lattice())
    regular[::3] = regular[::3, ::-1]
    anywhere = random_edges(rng, 90)
    hub = np.array([[k, 3] for k in range(PARTICLES) if k != 3] * 3)
    return {
        "shifts": (regular, [Shifts]),
        "rows": (anywhere, [Rows]),
        "hub": (hub, [Rows]),
        "pairs": (anywhere[:30], [Pairs]),
        "shifts and pairs": (np.concatenate([anywhere[:3], regular]), [Shifts, Pairs]),
        "shifts and rows": (np.concatenate([regular, anywhere[:40]]), [Shifts, Rows]),
    }


def cloth(side):
    at = np.arange(side * side).reshape(side, side)
    pairs = (at[:, :-1], at[:, 1:]), (at[:-1], at[1:]), (at[:-1, :-1], at[1:, 1:])
    return np.concatenate([np.stack([i.ravel(), j.ravel()], axis=1) for i, j in pairs])


def incidence_matrix(edges, particles):
    b = np.zeros((len(edges), particles))
    np.add.at(b, (np.arange(len(edges)), edges[:, 0]), 1)
    np.add.at(b, (np.arange(len(edges)), edges[:, 1]), -1)
    return b


def plain_force(edges):
    """The formula with gathers and scatter-add, for parameters of shape (spring,)."""
    i, j = edges[:, 0], edges[:, 1]

    def force(position, velocity, ks, kd, rest_length):
        d, s = position[i] - position[j], velocity[i] - velocity[j]
        r = jnp.sqrt(jnp.sum(d * d, axis=1))
        u = d / r[:, None]
        f = (ks * (rest_length - r) - kd * jnp.sum(s * u, axis=1))[:, None] * u
        return jnp.zeros_like(position).at[i].add(f).at[j].add(-f)

    return force


def spring_force(edges):
    return lambda p, v, ks, kd, rest_length: jeuler.Springs(edges, ks, kd, rest_length)(0.0, p, v, 1.0)


def check_equal(got, expected, tolerance=1e-10):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * float(jnp.abs(b).max()))


def weighted_sum(layout, weight, x):
    """B^T (w B x)."""
    x, weight = jnp.asarray(x), layout.to_slots(jnp.asarray(weight))
    return layout.central_force(lambda square, approach, w: w, [x], [x], [weight])[0]


@pytest.mark.parametrize("name", graphs())
def test_each_layout_is_the_incidence_matrix(name, random, monkeypatch):
    monkeypatch.setattr(layouts, "LONGEST_ROW", 8)  # so that the hub needs several rows
    monkeypatch.setattr(layouts, "GROUP_COST", 10)  # and there are rows of several lengths
    edges, _ = graphs()[name]
    b = incidence_matrix(edges, PARTICLES)
    x, e = random.normal(size=PARTICLES), random.normal(size=len(edges)) ** 2
    for layout in (kind(edges, np.arange(len(edges)), PARTICLES) for kind in (Rows, Pairs)):
        check_equal(weighted_sum(layout, e, x), b.T @ (e * (b @ x)), 1e-14)
        held = np.concatenate([slots.ravel() for slots in layout.slot_edges])
        assert (np.bincount(held[held >= 0], minlength=len(edges)) == 1).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), particles=st.integers(2, 25), count=st.integers(0, 80))
def test_chosen_layouts_agree_with_the_matrix_on_random_graphs(seed, particles, count):
    rng = np.random.default_rng(seed)
    edges = random_edges(rng, count, particles)
    if seed % 2:
        edges = np.concatenate([edges, lattice(particles, (1,))])
    b, x = incidence_matrix(edges, particles), rng.normal(size=particles)
    total = np.zeros(particles)
    for layout in Topology(edges).layouts(particles):
        total = total + weighted_sum(layout, 1.0, x)
    np.testing.assert_allclose(total, b.T @ (b @ x), rtol=0, atol=1e-12 * (1 + len(edges)))


@pytest.mark.parametrize("name", graphs())
def test_every_nesting_of_derivatives_equals_autodiff_of_the_plain_formula(name, random, monkeypatch):
    monkeypatch.setattr(layouts, "LONGEST_ROW", 20)
    edges, kinds = graphs()[name]
    assert [type(layout) for layout in Topology(edges).layouts(PARTICLES)] == kinds
    position, velocity, weight = random.normal(size=(3, PARTICLES, 2))
    parameters = random.uniform(0.5, 1.5, size=(3, len(edges)))
    args = tuple(map(jnp.asarray, (position, velocity, *parameters)))
    direction = tuple(jnp.asarray(random.normal(size=x.shape)) for x in args)
    positions = jnp.asarray(random.normal(size=(PARTICLES, 3, 2)))  # a batch on the middle axis
    ks = jnp.asarray(random.uniform(0.5, 1.5, size=(3, len(edges))))
    everything = range(5)

    def derivatives(force):
        def loss(*a):
            return jnp.sum(weight * force(*a) ** 2)

        def slope(*a):
            return jax.grad(loss, argnums=everything)(*a)

        def along(*a):
            return jax.jvp(force, a, direction)[1]

        @jax.jit
        def all_of_them(args):
            batched = positions, args[1], ks, *args[3:]
            axes = (1, None, 0, None, None)
            return {
                "value": force(*args),
                "forward": along(*args),
                "reverse": slope(*args),
                "forward over reverse": jax.jvp(slope, args, direction)[1],
                "reverse over reverse": jax.grad(
                    lambda *a: sum(map(jnp.vdot, slope(*a), direction)), argnums=everything
                )(*args),
                "reverse over forward": jax.grad(lambda *a: jnp.sum(along(*a) ** 2), argnums=everything)(*args),
                "vmap of reverse": jax.vmap(slope, in_axes=axes)(*batched),
                "reverse of vmap": jax.grad(
                    lambda *a: jnp.sum(jax.vmap(force, in_axes=axes)(*a) ** 2), argnums=everything
                )(*batched),
                "jacfwd": jax.jacfwd(force)(*args),
                "jacrev": jax.jacrev(force)(*args),
            }

        return all_of_them(args)

    check_equal(derivatives(spring_force(edges)), derivatives(plain_force(edges)))


@pytest.mark.parametrize("name", ["shifts", "rows", "pairs", "shifts and pairs"])
def test_a_run_and_its_gradient_equal_a_plain_loop(name, random):
    edges, _ = graphs()[name]
    position, velocity = jnp.asarray(random.normal(size=(2, PARTICLES, 3)))
    mass = jnp.asarray(random.uniform(1, 2, PARTICLES)).at[4].set(jnp.inf)
    parameters = tuple(jnp.asarray(random.uniform(0.5, 1.5, len(edges))) for _ in range(3))
    force, dt, steps = plain_force(edges), 0.01, 5

    def by_hand(position, velocity, mass, *parameters):
        velocity = velocity.at[4].set(0.0)
        for _ in range(steps):
            acceleration = force(position, velocity, *parameters) / mass[:, None]
            position, velocity = position + dt * velocity, velocity + dt * acceleration
        return position, velocity

    def by_jeuler(position, velocity, mass, *parameters):
        scene = jeuler.Scene((jeuler.Springs(edges, *parameters),))
        state = jeuler.ParticleState(position, velocity, mass)
        end = jeuler.simulate(scene, state, dt=dt, num_steps=steps).y
        return end.position[-1], end.velocity[-1]

    args = (position, velocity, mass, *parameters)
    check_equal(by_jeuler(*args), by_hand(*args), 1e-12)

    def slope(final):
        return jax.jit(jax.grad(lambda *a: sum(jnp.sum(x**2) for x in final(*a)), argnums=(0, 1, 3, 4, 5)))

    check_equal(slope(by_jeuler)(*args), slope(by_hand)(*args), 1e-10)


def test_the_rule_chooses_by_the_structure_of_the_edges(random, monkeypatch):
    shuffled = random.permutation(400)
    grid = cloth(20)

    def kinds(edges, particles):
        return [type(layout) for layout in Topology(edges).layouts(particles)]

    assert kinds(grid, 400) == [Shifts]
    assert kinds(shuffled[grid], 400) == [Rows]
    assert kinds(np.concatenate([grid, [[0, 300]]]), 400) == [Shifts, Pairs]
    assert kinds(np.concatenate([grid, random_edges(random, 200, 400)]), 400) == [Shifts, Rows]
    assert kinds(np.zeros((0, 2), int), 5) == []
    monkeypatch.setattr(topology, "MANY", len(grid) + 1)
    topology._layouts.cache_clear()
    assert kinds(shuffled[grid], 400) == [Pairs]
    topology._layouts.cache_clear()


def test_a_hub_does_not_pad_the_others():
    spokes = np.stack([np.zeros(10_000, int), np.arange(1, 10_001)], axis=1)
    rim = np.stack([np.arange(1, 10_000), np.random.default_rng(0).permutation(np.arange(2, 10_001))], axis=1)
    edges = np.concatenate([spokes, rim[rim[:, 0] != rim[:, 1]]])
    (layout,) = Topology(edges).layouts(10_001)
    assert sum(slots.size for slots in layout.slot_edges) < 1.1 * len(edges)
    assert sum(table.size for table in layout.tables) < 1.1 * 2 * len(edges) + 2 * 10_001


@pytest.mark.parametrize("name", ["shifts", "rows"])
def test_the_gradient_scatters_no_edges(name):
    edges, _ = graphs()[name]
    position = jnp.zeros((PARTICLES, 3))

    def loss(position, ks):
        scene = jeuler.Scene((jeuler.Springs(edges, ks, 0.1, 1.0),))
        state = jeuler.ParticleState(position, position)
        return jnp.sum(jeuler.simulate(scene, state, dt=0.1, num_steps=4, save_every=4).y.position[-1])

    program = jax.jit(jax.grad(loss, argnums=(0, 1))).lower(position, 1.0).as_text()
    updates = re.findall(r'"stablehlo.scatter".*?\}\) : \([^)]*, tensor<(\d+)x[^)]*\)', program, re.DOTALL)
    assert sorted(set(updates)) == {"shifts": [], "rows": ["2"]}[name]  # two empty rows, see Rows._accumulate


def test_the_program_does_not_grow_with_the_number_of_springs():
    def equations(edges, particles):
        def force(position):
            return jeuler.Springs(edges, 1.0, 1.0, 1.0)(0.0, position, position, 1.0)

        return (
            jax.jit(jax.grad(lambda p: jnp.sum(force(p)))).lower(jnp.ones((particles, 3))).as_text().count("stablehlo.")
        )

    assert equations(cloth(40), 1600) == equations(cloth(10), 100)


def test_memory_of_the_gradient_grows_as_the_root_of_the_steps():
    edges = cloth(12)
    position = jnp.asarray(np.random.default_rng(0).normal(size=(144, 3)))

    def megabytes(num_steps, checkpoint):
        def loss(position):
            scene = jeuler.Scene((jeuler.Springs(edges, 10.0, 0.1, 1.0),))
            state = jeuler.ParticleState(position, jnp.zeros_like(position))
            run = jeuler.simulate(
                scene, state, dt=1e-3, num_steps=num_steps, save_every=num_steps, checkpoint=checkpoint
            )
            return jnp.sum(run.y.position[-1] ** 2)

        compiled = jax.jit(jax.grad(loss)).lower(position).compile()
        return compiled.memory_analysis().temp_size_in_bytes / 1e6

    few, many = megabytes(256, "sqrt"), megabytes(1024, "sqrt")
    assert many < 2.3 * few
    assert many < megabytes(1024, None) / 5


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", ["shifts", "rows", "shifts and pairs"])
def test_coincident_ends_are_finite_and_without_rest_length_linear(name, dtype):
    edges, _ = graphs()[name]
    position = jnp.zeros((PARTICLES, 2), dtype)
    velocity = jnp.ones((PARTICLES, 2), dtype).at[0].set(5.0)

    def force(position, rest_length):
        return jeuler.Springs(edges, 7.0, 0.5, rest_length)(0.0, position, velocity, 1.0)

    jacobian, second = jax.jit(lambda p: (jax.jacfwd(force)(p, 0.0), jax.jacfwd(jax.jacrev(force))(p, 0.0)))(position)
    b = incidence_matrix(edges, PARTICLES)
    laplacian = np.einsum("ij,kl->ikjl", -7.0 * b.T @ b, np.eye(2))
    assert force(position, 1.0).dtype == dtype
    assert not force(position, 1.0).any()
    assert np.array_equal(jacobian, laplacian)
    assert not second.any()


@pytest.mark.parametrize("distance", [1e-18, 1e-11, 1e-6, 1e12])
def test_derivatives_in_float32_at_tiny_and_huge_distance(distance):
    def force(distance, rest_length):
        position = jnp.stack([jnp.zeros_like(distance), distance])[:, None] * jnp.ones(2, distance.dtype)
        return jeuler.Springs([[0, 1]], 3.0, 0.5, rest_length)(0.0, position, position, 1.0)[0, 0]

    def up_to_second(x):
        slope = jax.grad(force, argnums=(0, 1))
        return force(x, jnp.ones_like(x)), slope(x, jnp.ones_like(x)), jax.grad(lambda d: slope(d, 1.0)[0])(x)

    up_to_second = jax.jit(up_to_second)
    single, double = up_to_second(jnp.float32(distance)), up_to_second(jnp.float64(distance))
    orders = (
        0,
        (1, 0),
        2,
    )  # derivatives by distance; along the spring terms (1 + distance) / distance^n cancel
    for a, b, order in zip(*map(jax.tree.leaves, (single, double, orders)), strict=True):
        assert np.isfinite(a)
        if distance > 1e-13:  # nearer ends count as coincident in float32
            np.testing.assert_allclose(a, b, rtol=3e-6, atol=3e-6 * (1 + distance) * distance**-order)


def test_a_lost_member_of_a_batch_leaves_the_others_alone(random):
    edges = lattice()
    position = jnp.asarray(random.normal(size=(3, PARTICLES, 3)))
    scene = jeuler.Scene((jeuler.Springs(edges, 5.0, 0.1, 1.0),))

    def run(position):
        state = jeuler.ParticleState(position, jnp.zeros_like(position))
        return jeuler.simulate(scene, state, dt=0.01, num_steps=5)

    sound, broken = jax.vmap(run)(position), jax.vmap(run)(position.at[1, 4].set(jnp.inf))
    assert broken.first_nonfinite.tolist() == [-1, 1, -1]
    for k in (0, 2):
        np.testing.assert_array_equal(sound.y.position[k], broken.y.position[k])


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("name", graphs())
def test_a_linearised_force_with_a_copy_of_its_tables_for_each_member(name, moving, random):
    """A batched loop that keeps a Jacobian, such as Levenberg-Marquardt's, selects each of its arrays by member."""
    edges, _ = graphs()[name]
    position, direction = jnp.asarray(random.normal(size=(2, PARTICLES, 2)))

    def force(p):
        return spring_force(edges)(p, jnp.zeros_like(p), 1.0, 0.0, 1.0)

    _, push = jax.linearize(force, position)
    leaves, tree = jax.tree.flatten(push)

    def derivative(kept, scale):
        selected = tree.unflatten([jnp.where(kept, x, jnp.zeros_like(x)) for x in leaves])
        d = scale * direction if moving else direction
        return selected(d), *jax.linear_transpose(selected, d)(d)

    got = jax.jit(jax.vmap(derivative))(jnp.array([True, True]), jnp.array([1.0, 3.0]))
    expected = jax.jvp(force, (position,), (direction,))[1]  # symmetric
    check_equal(got, [jnp.stack([expected, (3.0 if moving else 1.0) * expected])] * 2)


def test_importing_jeuler_imports_nothing_heavy():
    program = (
        "import sys, jax; before = set(sys.modules); import jeuler; "
        "heavy = {'scipy.sparse.csgraph', 'diffrax', 'equinox', 'optax', 'matplotlib', 'lineax'}; "
        "print(sorted((set(sys.modules) - before) & heavy))"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
