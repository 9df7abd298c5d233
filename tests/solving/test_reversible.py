"""checkpoint="reversible": the gradient of the stored run at the memory of one state, or an error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler


def pendulum(t, y, args):
    angle, rate = y
    return rate, {"a": -args * jnp.sin(angle["a"]) + 0.1 * jnp.cos(t)}


START = {"a": jnp.array([1.0, 2.0, 3.0])}, {"a": jnp.zeros(3)}


def net(dtype=float):
    at = np.arange(16).reshape(4, 4)
    edges = np.concatenate(
        [np.stack([i.ravel(), j.ravel()], 1) for i, j in ((at[1:], at[:-1]), (at[:, 1:], at[:, :-1]))]
    )
    position = np.random.default_rng(1).normal(0, 0.1, (16, 3)) + np.stack(
        [*np.divmod(at.ravel(), 4), 0 * at.ravel()], 1
    )
    mass = np.r_[np.inf, np.ones(15)]

    def final(position, velocity, ks, mass, dt, checkpoint, num_steps=200, save_every=50):
        scene = jeuler.Scene((jeuler.Springs(edges, ks, 0.0, 1.0), jeuler.Gravity(jnp.array([0.0, 0.0, -1.0], dtype))))
        run = jeuler.simulate(
            scene, jeuler.ParticleState(position, velocity, mass=mass), dt=dt, num_steps=num_steps,
            save_every=save_every, step=jeuler.symplectic_euler_step, checkpoint=checkpoint,
        )  # fmt: skip
        return jnp.sum(run.y.position**2) + jnp.sum(run.y.velocity[-1] ** 2)

    args = (position, 0 * position, 40.0, mass, 0.01)
    return final, tuple(jnp.asarray(x, dtype) for x in args)


@pytest.mark.parametrize("save_every", [1, 10, 60])
def test_gradient_of_solve_equals_that_of_the_stored_run(save_every):
    def loss(y0, k, dt, t0, checkpoint):
        run = jeuler.solve(
            pendulum, y0, dt=dt, t0=t0, num_steps=60, args=k, step=jeuler.symplectic_euler_step,
            save_every=save_every, checkpoint=checkpoint,
        )  # fmt: skip
        return sum(jnp.sum(leaf**3) for leaf in jax.tree.leaves(run.y))

    args = START, jnp.array(2.0), jnp.array(0.05), jnp.array(0.3)
    values = [
        jax.value_and_grad(lambda *a, c=c: loss(*a, c), argnums=(0, 1, 2, 3))(*args) for c in (None, "reversible")
    ]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10), *values)


def test_gradient_of_a_net_for_every_parameter_and_in_a_batch():
    final, args = net()
    stored, undone = (
        jax.jit(jax.value_and_grad(lambda *a, c=c: final(*a, c), argnums=(0, 1, 2, 3, 4)))(*args)
        for c in (None, "reversible")
    )
    for a, b in zip(jax.tree.leaves(stored), jax.tree.leaves(undone), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * float(jnp.abs(a).max()))
    ks = jnp.array([20.0, 40.0])
    slopes = [jax.grad(lambda k, c=c: final(*args[:2], k, *args[3:], c)) for c in ("reversible", None)]
    np.testing.assert_allclose(*(jax.jit(jax.vmap(slope))(ks) for slope in slopes), rtol=1e-9)


@pytest.mark.optimised
@pytest.mark.parametrize(("dtype", "num_steps"), [(jnp.float32, 3000), (jnp.float64, 10_000)])
def test_chaotic_run_is_undone_to_the_bit(dtype, num_steps):
    """The gradient has grown by 1e8 and more: roundoff on the way back would end elsewhere, and NaN would say so."""
    final, args = net(dtype)
    loss = lambda *a: final(*a, "reversible", num_steps=num_steps, save_every=num_steps)  # noqa: E731
    by_position, by_ks = jax.jit(jax.grad(loss, argnums=(0, 2)))(*args)
    assert jnp.isfinite(by_position).all()
    assert jnp.isfinite(by_ks)
    assert jnp.abs(by_position).max() > 1e8


def test_memory_does_not_grow_with_the_steps():
    final, args = net()

    def memory(num_steps, checkpoint):
        loss = lambda *a: final(*a, checkpoint, num_steps, num_steps)  # noqa: E731
        return jax.jit(jax.grad(loss)).lower(*args).compile().memory_analysis().temp_size_in_bytes

    assert memory(6400, "reversible") == memory(400, "reversible") < memory(400, "sqrt") < memory(6400, "sqrt")


def test_lost_step_is_numbered_and_its_gradient_not_finite():
    def loss(y, checkpoint="reversible"):
        run = jeuler.solve(
            lambda t, y, args: (y[1], y[0] ** 3), (y, y), dt=0.1, num_steps=200, save_every=200,
            step=jeuler.symplectic_euler_step, checkpoint=checkpoint,
        )  # fmt: skip
        return run.y[0][-1], run.first_nonfinite

    slope, first = jax.grad(loss, has_aux=True)(1.0)
    assert first == loss(1.0, None)[1] > 0
    assert not np.isfinite(slope)


def test_damper_is_an_error_and_where_values_are_traced_a_gradient_of_nan():
    def loss(kd):
        return jnp.sum(
            jeuler.solve(
                lambda t, y, args: (y[1], -y[0] - args * y[1]), (jnp.ones(2), jnp.zeros(2)), dt=0.1, num_steps=50,
                args=kd, step=jeuler.symplectic_euler_step, save_every=50, checkpoint="reversible",
            ).y[0][-1]
        )  # fmt: skip

    with pytest.raises(ValueError, match="does not depend on the velocity"):
        loss(0.1)
    assert np.isfinite(jax.grad(loss)(0.0))
    assert np.isnan(jax.grad(loss)(0.1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": jeuler.euler_step}, "needs symplectic_euler_step in plain sums, got euler_step"),
        ({"compensated": True}, "got compensated sums"),
        ({"y0": (jnp.ones(2, complex), jnp.ones(2, complex))}, "needs a real state, got complex128"),
        ({"y0": jnp.ones(2)}, r"y must be the pair \(position, velocity\)"),
    ],
)
def test_bad_input_of_solve(change, message):
    given = {"y0": (jnp.ones(2), jnp.ones(2)), "step": jeuler.symplectic_euler_step} | change
    with pytest.raises(ValueError, match=message):
        jeuler.solve(lambda t, y, args: y, given.pop("y0"), dt=0.1, num_steps=2, checkpoint="reversible", **given)


def test_bad_input_of_simulate():
    scene = jeuler.Scene(effects=(jeuler.SpeedLimit(1.0),))
    with pytest.raises(ValueError, match="cannot undo effects or births, got SpeedLimit"):
        jeuler.simulate(
            scene, jeuler.ParticleState(jnp.ones((1, 2)), jnp.ones((1, 2))), dt=0.1, num_steps=2,
            step=jeuler.symplectic_euler_step, checkpoint="reversible",
        )  # fmt: skip
