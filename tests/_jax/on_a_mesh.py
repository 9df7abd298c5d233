"""Run by test_placed.py in a process with eight devices: each way to place a batch on them, beside one device."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jeuler

MEMBERS, BATCH = 64, PartitionSpec("batch")
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")


def oscillator(x):
    def field(t, y, args):
        return y[1], -x[1] * y[0]  # reads what is placed from around it

    return jeuler.solve(field, (x[0], 0 * x[0]), dt=0.1, num_steps=4, step=jeuler.symplectic_euler_step).y[0]


def pair(x):
    springs = jeuler.Springs([[0, 1]], ks=10 * x[0], kd=0.1, rest_length=1.0)
    scene = jeuler.Scene((springs, jeuler.Gravity([0.0, -9.8])))
    state = jeuler.ParticleState(jnp.array([[0.0, 0.0], [1.5, 0.0]]) + x[1], jnp.zeros((2, 2)))
    return jeuler.simulate(scene, state, dt=0.01, num_steps=4, save_every=2).y.position


def explicit_steps(x):
    return oscillator(x), pair(x)


def implicit_step(x):
    return jeuler.solve(lambda t, y, a: -x * y**3, x, dt=0.1, num_steps=2, step=jeuler.implicit_euler_step).y


def shared(x):
    def mean_field(t, y, args):
        return jax.lax.pmean(y.mean(), "batch") - y  # members that talk to each other

    return jeuler.solve(mean_field, x, dt=0.1, num_steps=2).y


def with_gradient(run):
    def total(x):
        y = run(x)
        return sum(jnp.sum(y**2) for y in jax.tree.leaves(y)), y

    return jax.grad(total, has_aux=True)


def ways(run, x):
    """Name of the way, compiled text, results of all members."""
    explicit = jax.make_mesh((8,), ("batch",), axis_types=(AxisType.Explicit,))
    auto = jax.make_mesh((8,), ("batch",), axis_types=(AxisType.Auto,))
    batch = jax.vmap(run)
    for name, mesh in {"explicit": explicit, "auto": auto}.items():
        placed = jax.device_put(x, NamedSharding(mesh, BATCH))
        yield name, jax.jit(batch), placed
    yield (
        "explicit, not jitted",
        batch if run is pair else jax.jit(batch),
        jax.device_put(x, NamedSharding(explicit, BATCH)),
    )
    for check in (True, False):
        each = jax.shard_map(batch, mesh=auto, in_specs=BATCH, out_specs=BATCH, check_vma=check)
        yield f"shard_map, check_vma={check}", jax.jit(each), x
    yield "pmap", jax.pmap(batch), x.reshape(8, -1, *x.shape[1:])


def check(run, x, among, collectives):
    expected = jax.jit(jax.vmap(run))(x)
    for name, function, placed in ways(run, x):
        if name not in among:
            continue
        for a, b in zip(jax.tree.leaves(function(placed)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(np.asarray(a).reshape(b.shape), b, rtol=2e-6, atol=2e-6, err_msg=name)
            assert len(a.sharding.device_set) == 8, name
        if not collectives and hasattr(function, "lower"):
            text = function.lower(placed).compile().as_text()
            assert not [one for one in COLLECTIVES if one in text], name
        print(name)


x = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, (MEMBERS, 2)), jnp.float32)
mapped = ("shard_map, check_vma=True", "shard_map, check_vma=False", "pmap")
check(with_gradient(explicit_steps), x, ("explicit", *mapped[::2]), collectives=False)
check(oscillator, x, ("auto", *mapped), collectives=False)
check(pair, x, ("explicit, not jitted",), collectives=True)
check(implicit_step, x, ("explicit",), collectives=True)  # its iterations end where those of all members do
check(implicit_step, x, mapped[:2], collectives=False)

mesh = jax.make_mesh((8,), ("batch",), axis_types=(AxisType.Auto,))
together = jax.shard_map(shared, mesh=mesh, in_specs=BATCH, out_specs=PartitionSpec(None, "batch"))
alone = jeuler.solve(lambda t, y, args: y.mean() - y, x[:, 0], dt=0.1, num_steps=2).y
np.testing.assert_allclose(jax.jit(together)(x[:, 0]), alone, rtol=2e-6)
divided = jax.device_put(x[:, 0], NamedSharding(jax.make_mesh((8,), ("batch",)), BATCH))
run = jeuler.solve(lambda t, y, args: divided - y, divided, dt=0.1, num_steps=2)
assert run.y.sharding.spec == PartitionSpec(None, "batch")
found = [
    jeuler.ensemble(implicit_step, np.asarray(x), mesh=one, batch=32, reduce=jeuler.Moments()).reduced
    for one in (mesh, None)
]
np.testing.assert_allclose(*(moments.variance for moments in found), rtol=1e-5)
