"""Ensembles equal a plain vmap, whatever the batches; what is reduced equals NumPy's; lost members are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler

RNG = np.random.default_rng(0)
MEMBERS = {"start": RNG.normal(size=1003), "ks": RNG.uniform(1, 2, 1003), "dt": RNG.uniform(0.01, 0.02, 1003)}
MEMBERS["start"][[5, 1002]] = np.nan, np.inf
GOOD = np.delete(np.arange(1003), [5, 1002])


def trajectory(member):
    def field(t, y, ks):
        return y[1], -ks * y[0]

    start = member["start"], 0 * member["start"]
    run = jeuler.solve(field, start, args=member["ks"], dt=member["dt"], num_steps=20, save_every=10)
    return run.y[0]


@pytest.fixture(scope="module")
def stored():
    return jeuler.ensemble(trajectory, MEMBERS, batch=400)


def test_results_are_those_of_one_member_after_another(stored):
    assert stored.results.shape == (1003, 3)
    assert stored.lost.tolist() == [5, 1002]
    one = trajectory({name: x[700] for name, x in MEMBERS.items()})
    np.testing.assert_allclose(stored.results[700], one, rtol=1e-14)


def test_moments_and_quantiles_are_those_of_the_members_that_were_not_lost(stored):
    reduce = {"moments": jeuler.Moments(), "quantiles": jeuler.Quantiles((0.0, 0.1, 0.5, 1.0))}
    told = []
    found = jeuler.ensemble(trajectory, MEMBERS, batch=400, reduce=reduce, progress=lambda n, of: told.append((n, of)))
    assert told == [(400, 1003), (800, 1003), (1003, 1003)]
    assert found.lost.tolist() == [5, 1002]
    good = stored.results[GOOD]
    moments, quantiles = found.reduced["moments"], found.reduced["quantiles"]
    assert moments.count == 1001
    np.testing.assert_allclose(moments.mean, good.mean(axis=0), atol=1e-14)
    np.testing.assert_allclose(moments.variance, good.var(axis=0, ddof=1), rtol=1e-12)
    exact = np.quantile(good, (0.0, 0.1, 0.5, 1.0), axis=0)
    assert np.all(np.abs(quantiles.quantiles - exact) <= 3 * quantiles.resolution + 2e-2 * np.abs(exact[0]))
    assert not quantiles.outside.any()


@pytest.mark.parametrize("values", [np.full(10, 3.0), np.full(10, 1e6 + 0.5), np.zeros(10), np.array([1.0])])
def test_equal_members_and_one_alone(values):
    reduce = {"moments": jeuler.Moments(), "quantiles": jeuler.Quantiles((0.5,))}
    found = jeuler.ensemble(lambda x: x, values, batch=4, reduce=reduce)
    np.testing.assert_allclose(found.reduced["quantiles"].quantiles, values[:1], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.reduced["moments"].mean, values[0])
    np.testing.assert_array_equal(found.reduced["moments"].variance, 0.0 if len(values) > 1 else np.nan)


def test_values_beyond_the_bounds_are_counted_and_a_reducer_of_ones_own_does():
    class Largest:
        def start(self, results, kept):
            return jnp.float64(-jnp.inf)

        def add(self, state, results, kept):
            return jnp.maximum(state, jnp.max(jnp.where(kept, results, -jnp.inf)))

        def merge(self, a, b):
            return jnp.maximum(a, b)

        def value(self, state):
            return float(state)

    reduce = {"largest": Largest(), "quantiles": jeuler.Quantiles((0.5,), bounds=(0.0, 5.0))}
    found = jeuler.ensemble(lambda x: x, np.arange(10.0), batch=3, reduce=reduce)
    assert found.reduced["largest"] == 9.0
    assert found.reduced["quantiles"].outside == 4
    assert np.isnan(jeuler.ensemble(lambda x: x, np.full(3, np.nan), reduce=jeuler.Moments()).reduced.mean)


def test_keys_are_members():
    keys = jax.random.split(jax.random.key(0), 7)
    found = jeuler.ensemble(lambda key: jax.random.normal(key), keys, batch=4)
    np.testing.assert_array_equal(found.results, jax.vmap(jax.random.normal)(keys))


def test_wrong_arguments_are_told():
    for wrong, match in (
        (lambda: jeuler.ensemble(trajectory, {"a": np.ones(3), "b": np.ones(4)}), "one leading axis"),
        (lambda: jeuler.ensemble(trajectory, 1.0), "one leading axis"),
        (lambda: jeuler.ensemble(trajectory, np.ones(3), reduce=3), "start, add, merge and value"),
        (lambda: jeuler.ensemble(3, np.ones(3)), "run must be a function"),
        (lambda: jeuler.ensemble(lambda x: x, np.ones(3), batch=0), "batch must be at least 1"),
        (lambda: jeuler.Quantiles((1.5,)), "from 0 to 1"),
        (lambda: jeuler.Quantiles(bounds=(1.0, 0.0)), "Quantiles.bounds"),
    ):
        with pytest.raises(ValueError, match=match):
            wrong()
