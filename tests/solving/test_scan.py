"""solve: diffrax's numbers, the clock, saving, memory, derivatives, bad input."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import METHODS, PROBLEMS

import jeuler

STEPS = 64


def as_dtype(tree, dtype):
    def leaf(x):
        x = jnp.asarray(x)
        complex_dtype = jnp.complex64 if dtype == jnp.float32 else jnp.complex128
        return x.astype(complex_dtype if jnp.iscomplexobj(x) else dtype)

    return jax.tree.map(leaf, tree)


def ours(problem, y0, args, dtype=jnp.float64):
    return jeuler.solve(problem.f, y0, dt=problem.t1 / STEPS, num_steps=STEPS, args=args).y


def theirs(problem, y0, args, dtype=jnp.float64):
    dt = jnp.asarray(problem.t1 / STEPS, dtype)
    grid = jnp.arange(STEPS + 1, dtype=dtype) * dt
    return diffrax.diffeqsolve(
        diffrax.ODETerm(problem.f),
        diffrax.Euler(),
        grid[0],
        grid[-1],
        None,
        y0,
        args=args,
        stepsize_controller=diffrax.StepTo(grid),
        saveat=diffrax.SaveAt(ts=grid),
        adjoint=diffrax.DirectAdjoint(),
        max_steps=STEPS,
    ).ys


@functools.cache
def run_both(name, dtype):
    """Values and gradients of both solvers, batched over perturbed starts."""
    problem = PROBLEMS[name]
    y0, args = as_dtype(problem.y0, dtype), as_dtype(problem.args, dtype)
    batch = jax.tree.map(lambda x: x * jnp.array([1.0, 0.9, 1.05], x.real.dtype).reshape(3, *[1] * x.ndim), y0)

    def run(solver, y0):
        def scalar(y0, args):
            y = solver(problem, y0, args, dtype)
            return sum(jnp.sum(jnp.abs(leaf) ** 2) for leaf in jax.tree.leaves(y)), y

        return jax.grad(scalar, argnums=(0, 1), has_aux=True)(y0, args)

    one, plain, many = jax.jit(
        lambda: (run(ours, y0), ours(problem, y0, args), jax.vmap(lambda y: run(ours, y))(batch))
    )()
    reference = jax.jit(jax.vmap(lambda y: run(theirs, y)))(batch)
    first = jax.tree.map(lambda x: x[0], reference)
    return (one, plain, many), (first, first[1], reference)


def relative(a, b):
    scale = max(float(jnp.max(jnp.abs(b))), 1e-300)
    return float(jnp.max(jnp.abs(a - b))) / scale


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-12), (jnp.float32, 1e-5)])
def test_agrees_with_diffrax_euler(name, dtype, tolerance):
    mine, reference = run_both(name, dtype)
    differences = jax.tree.map(relative, mine, reference)
    assert max(jax.tree.leaves(differences)) < tolerance, differences


@pytest.mark.parametrize("name", METHODS)
def test_transformations_agree_with_loops_and_differences(name):
    step = METHODS[name].step

    def final(ks):
        y = jeuler.solve(
            PROBLEMS["pendulum"].f, (jnp.array(1.0), jnp.array(0.0)), dt=0.05, num_steps=20, args=ks, step=step
        ).y
        return y[0][-1]

    ks, h = jnp.array(9.81), 1e-5
    slope = (final(ks + h) - final(ks - h)) / (2 * h)
    bend = (final(ks + 1e-3) - 2 * final(ks) + final(ks - 1e-3)) / 1e-6
    np.testing.assert_allclose(jax.jit(final)(ks), final(ks), rtol=1e-13)
    np.testing.assert_allclose(jax.grad(final)(ks), slope, rtol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(final)(ks), slope, rtol=1e-7)
    np.testing.assert_allclose(jax.hessian(final)(ks), bend, rtol=1e-4)
    np.testing.assert_allclose(jax.grad(jax.grad(final))(ks), bend, rtol=1e-4)
    batch = jnp.array([1.0, 9.81, 20.0])
    np.testing.assert_allclose(jax.vmap(final)(batch), [final(k) for k in batch], rtol=1e-13)


def growth(t, y, args):
    return args * y


@pytest.mark.parametrize("save_every", [1, 2, 5, 60])
def test_save_every(save_every):
    all_of_it = jeuler.solve(growth, 1.0, dt=0.1, num_steps=60, args=0.3, t0=2.0)
    some = jeuler.solve(growth, 1.0, dt=0.1, num_steps=60, args=0.3, t0=2.0, save_every=save_every)
    assert len(some.t) == 60 // save_every + 1
    np.testing.assert_array_equal(some.t, all_of_it.t[::save_every])
    np.testing.assert_allclose(some.y, all_of_it.y[::save_every], rtol=1e-15)


def test_save_makes_what_is_kept():
    solution = jeuler.solve(growth, jnp.ones(3), dt=0.1, num_steps=4, args=0.3, save=lambda t, y: {"sum": y.sum() + t})
    assert solution.y["sum"].shape == (5,)
    np.testing.assert_allclose(solution.y["sum"], 3 * 1.03 ** np.arange(5) + 0.1 * np.arange(5))


@pytest.mark.parametrize("num_steps", [0, 1])
def test_few_steps(num_steps):
    solution = jeuler.solve(growth, 1.0, dt=0.5, num_steps=num_steps, args=1.0)
    np.testing.assert_allclose(solution.y, [1.0, 1.5][: num_steps + 1])
    np.testing.assert_allclose(solution.t, [0.0, 0.5][: num_steps + 1])


@pytest.mark.parametrize("checkpoint", [None, 1, 7, 12, 1000, "sqrt"])
@pytest.mark.parametrize("save_every", [1, 12, 60])
def test_checkpoint_changes_nothing_but_memory(checkpoint, save_every):
    def loss(k):
        return jnp.sum(
            jeuler.solve(growth, 1.0, dt=0.1, num_steps=60, args=k, save_every=save_every, checkpoint=checkpoint).y
        )

    value, slope = jax.jit(jax.value_and_grad(loss))(0.3)
    n = np.arange(0, 61, save_every)
    np.testing.assert_allclose(value, np.sum(1.03**n), rtol=1e-13)
    np.testing.assert_allclose(slope, np.sum(0.1 * n * 1.03 ** np.maximum(n - 1, 0)), rtol=1e-12)


def test_clock_counts_steps():
    """A float32 sum of 0.1 is wrong by 1e-3 after 100,000 steps; a counted clock is right to one rounding."""
    solution = jeuler.solve(
        lambda t, y, a: 0 * y, jnp.float32(0), dt=0.1, num_steps=100_000, save_every=100_000, t0=3.0
    )
    assert solution.t.dtype == jnp.float32
    assert abs(float(solution.t[-1]) - 10_003.0) <= 2 * np.spacing(np.float32(10_003))


def test_first_nonfinite_counts_from_one_and_per_member():
    def f(t, y, args):
        return y * y

    def run(y0):
        return jeuler.solve(f, y0, dt=1.0, num_steps=12, save_every=4).first_nonfinite

    starts = jnp.array([1e200, 0.1, 1e5, jnp.nan])
    by_hand = []
    for y in np.asarray(starts):
        n = 0
        while n < 12 and (np.isfinite(y) or n == 0):
            with np.errstate(over="ignore"):
                y, n = y + y * y, n + 1
        by_hand.append(-1 if np.isfinite(y) else n)
    assert by_hand[1] == -1
    assert by_hand[0] == 1
    assert jax.vmap(run)(starts).tolist() == by_hand
    assert run(starts[2]).dtype == jnp.int32


def test_weak_and_mixed_dtypes():
    y0 = {"a": jnp.float32(1), "b": jnp.ones(2), "c": 1.0 + 0j}
    solution = jeuler.solve(lambda t, y, a: jax.tree.map(lambda x: -x, y), y0, dt=0.1, num_steps=3)
    assert solution.y["a"].dtype == jnp.float32
    assert solution.y["b"].dtype == jnp.float64
    assert solution.t.dtype == jnp.float64
    for leaf in jax.tree.leaves(solution.y):
        np.testing.assert_allclose(jnp.abs(leaf[-1]), 0.9**3, rtol=1e-6)


def test_half_precision_state_keeps_its_dtype():
    solution = jeuler.solve(lambda t, y, a: -y, jnp.ones(2, jnp.bfloat16), dt=0.5, num_steps=3)
    assert solution.y.dtype == jnp.bfloat16
    assert solution.t.dtype == jnp.float32


def test_integer_slope_is_taken_as_numbers():
    solution = jeuler.solve(lambda t, y, a: jnp.ones(2, int), jnp.zeros(2), dt=0.5, num_steps=3)
    np.testing.assert_allclose(solution.y[-1], 1.5)


def test_gradient_with_respect_to_the_step_size_and_start():
    def final(dt, t0):
        return jeuler.solve(lambda t, y, a: y + t, 1.0, dt=dt, num_steps=10, t0=t0).y[-1]

    h = 1e-6
    by_dt, by_t0 = jax.grad(final, argnums=(0, 1))(0.1, 0.5)
    np.testing.assert_allclose(by_dt, (final(0.1 + h, 0.5) - final(0.1 - h, 0.5)) / (2 * h), rtol=1e-7)
    np.testing.assert_allclose(by_t0, (final(0.1, 0.5 + h) - final(0.1, 0.5 - h)) / (2 * h), rtol=1e-7)


@pytest.mark.optimised
@pytest.mark.parametrize("jit", [False, True])
def test_compensated_sum_keeps_what_rounding_cuts_off(jit):
    """A constant slope in float32: the exact end is known, a plain sum drifts by far more than one rounding."""

    def run(compensated):
        return jeuler.solve(
            lambda t, y, a: a, jnp.float32(1), dt=1e-5, num_steps=100_000, args=jnp.float32(1 / 3),
            save_every=100_000, compensated=compensated,
        ).y[-1]  # fmt: skip

    wrap = jax.jit if jit else (lambda f: f)
    plain, kept = wrap(lambda: run(False))(), wrap(lambda: run(True))()
    exact = 1 + 1 / 3
    assert abs(float(kept) - exact) < 1e-6
    assert abs(float(plain) - exact) > 1e-4


@pytest.mark.parametrize("name", METHODS)
def test_compensated_gradient_equals_the_plain_one(name):
    def loss(k, compensated):
        y = jeuler.solve(
            PROBLEMS["oscillator"].f, (1.0, 0.0), dt=0.05, num_steps=40, args=(k, 0.3), step=METHODS[name].step,
            compensated=compensated,
        ).y  # fmt: skip
        return y[0][-1] ** 2

    plain, kept = (jax.grad(loss)(4.0, c) for c in (False, True))
    np.testing.assert_allclose(kept, plain, rtol=1e-12)


GOOD = {"dt": 0.1, "num_steps": 10}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0}, "dt must not be 0 s"),
        ({"dt": 1e-320}, "dt must be from 2.2e-308 to 1.8e.308 s in float64"),
        ({"dt": True}, "dt must be one finite real number, got True"),
        ({"dt": np.nan}, "dt must be one finite real number"),
        ({"dt": np.inf}, "dt must be one finite real number"),
        ({"dt": "fast"}, "dt must be one finite real number, got 'fast'"),
        ({"dt": None}, "dt must be one finite real number"),
        ({"dt": np.ones(2)}, "vmap"),
        ({"dt": 1j}, "dt must be one finite real number"),
        ({"t0": np.nan}, "t0 must be one finite real number"),
        ({"num_steps": -1}, "num_steps must be at least 0, got -1"),
        ({"num_steps": 2.5}, "num_steps must be a Python integer, got 2.5"),
        ({"num_steps": 10.0}, "num_steps must be a Python integer"),
        ({"num_steps": True}, "num_steps must be a Python integer"),
        ({"save_every": 3}, "save_every must divide num_steps, got save_every=3 and num_steps=10"),
        ({"save_every": 0}, "save_every must be at least 1"),
        ({"checkpoint": "log"}, 'checkpoint must be None, "sqrt", "reversible" or a number of steps'),
        ({"checkpoint": 0}, "checkpoint must be at least 1"),
        ({"compensated": True, "step": lambda f, t, y, dt, args: y}, "compensated=True needs an explicit step"),
    ],
)  # fmt: skip
def test_bad_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        jeuler.solve(growth, 1.0, args=1.0, **{**GOOD, **change})


@pytest.mark.parametrize(
    ("f", "y0", "message"),
    [
        (lambda t, y, a: -y, jnp.arange(3), "y0 must be floating, got int"),
        (lambda t, y, a: -y, 1, "y0 must be floating, got int"),
        (lambda t, y, a: -y, "y", "y0 must be an array, got 'y'"),
        (lambda t, y, a: y, {"n": jnp.array(True)}, r"y0\['n'\] must be floating, got bool"),
        (lambda t, y, a: y.astype(complex), jnp.ones(2), "keep the dtype of y, float64, got complex128"),
        (lambda t, y, a: y * np.float64(1), jnp.ones(2, jnp.float32), "keep the dtype of y, float32, got float64"),
        (lambda t, y, a: y[:1], jnp.ones(2), r"keep the shape of y, \(2,\), got \(1,\)"),
        (lambda t, y, a: (y, y), jnp.ones(2), "return the structure of the state"),
    ],
)
def test_bad_states_and_fields(f, y0, message):
    with pytest.raises(ValueError, match=message):
        jeuler.solve(f, y0, **GOOD)


def test_traced_count_says_what_to_do():
    with pytest.raises(ValueError, match="static_argnames"):
        jax.jit(lambda n: jeuler.solve(growth, 1.0, dt=0.1, num_steps=n, args=1.0).y)(3)


def test_nothing_is_mutated():
    y0 = np.ones(3)
    jeuler.solve(growth, y0, dt=0.1, num_steps=3, args=1.0)
    np.testing.assert_array_equal(y0, np.ones(3))


def test_name_of_a_step_is_not_a_step():
    with pytest.raises(ValueError, match="step must be a function .* got 'euler'"):
        jeuler.solve(lambda t, y, args: -y, 1.0, dt=0.1, num_steps=2, step="euler")


def test_a_field_without_args():
    with pytest.raises(ValueError, match=r"f must be a function \(t, y, args\) -> dy/dt, got <lambda>\(t, y\)"):
        jeuler.solve(lambda t, y: -y, 1.0, dt=0.1, num_steps=2)
