"""Ensembles equal a plain vmap, whatever the batches; what is reduced equals NumPy's; lost members are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

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


class Killed(BaseException):
    """Nothing is done at the end, as after kill -9."""


BOTH = {"moments": jeuler.Moments(), "quantiles": jeuler.Quantiles((0.1, 0.5))}


def numbers(found):
    return jax.tree.leaves((found.results, [vars(value) for value in (found.reduced or {}).values()]))


@pytest.mark.optimised
@pytest.mark.parametrize("mesh", [None, "one device"])
@pytest.mark.parametrize("reduce", [None, BOTH])
@pytest.mark.parametrize("stop", [Killed, KeyboardInterrupt])
def test_an_ensemble_goes_on_from_its_folder_with_the_numbers_of_one_in_one_go(tmp_path, mesh, reduce, stop):
    how = {"reduce": reduce, "batch": 100, "mesh": mesh and jax.make_mesh((1,), ("member",))}
    told = []

    def until(last):
        def progress(n, of):
            told.append(n)
            if n == last:
                raise stop

        return progress

    whole = jeuler.ensemble(trajectory, MEMBERS, **how)
    how |= {"resume": tmp_path / "run", "checkpoint_every": 200}
    for last in (100, 700):
        with pytest.raises(stop):
            jeuler.ensemble(trajectory, MEMBERS, progress=until(last), **how)
    found = jeuler.ensemble(trajectory, MEMBERS, progress=until(None), **how)
    first, again = (1, 7) if stop is Killed else (2, 8)  # the first batch that was not kept
    begun = [1, *range(first, 8), *range(again, 11)]
    assert told == [min(100 * n, 1003) for n in (*begun, 11)]
    told.clear()
    for one in (found, jeuler.ensemble(trajectory, MEMBERS, progress=until(None), **how)):
        assert one.lost.tolist() == [5, 1002]
        for a, b in zip(numbers(one), numbers(whole), strict=True):
            np.testing.assert_array_equal(np.asarray(a), b)
    assert not told  # a finished one does nothing
    other = {"reduce": jeuler.Moments()}, {"batch": 200}, {"mesh": None, "reduce": jeuler.Quantiles(bins=3)}
    for change in other:
        with pytest.raises(ValueError, match="holds another run: another function, members, reducer, batch"):
            jeuler.ensemble(trajectory, MEMBERS, **how | change)
    with pytest.raises(ValueError, match="holds another run"):
        jeuler.ensemble(trajectory, MEMBERS | {"ks": MEMBERS["ks"] + 1e-9}, **how)


@pytest.mark.parametrize("dtype", ["bool", "int32", "float16", "float32", "float64"])
def test_results_of_any_kind_are_reduced_and_go_on(tmp_path, dtype):
    values = (np.arange(3001) % 3).astype(dtype)
    how = {"reduce": BOTH, "batch": 1000, "resume": tmp_path / "run", "checkpoint_every": 1000}

    def until(n, of):
        if n == 2000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jeuler.ensemble(lambda x: x, values, progress=until, **how)
    found = jeuler.ensemble(lambda x: x, values, **how).reduced["moments"]
    np.testing.assert_allclose(found.mean, values.astype(float).mean(), rtol=1e-6)
    np.testing.assert_allclose(found.variance, values.astype(float).var(ddof=1), rtol=1e-6)


def test_a_reducer_whose_state_changes_its_form_cannot_be_kept_and_says_so(tmp_path):
    class Sum:
        def start(self, results, kept):
            return jnp.int32(0)

        def add(self, state, results, kept):
            return state + results.sum()

        merge = add
        value = float

    assert jeuler.ensemble(lambda x: x, np.ones(4), reduce=Sum()).reduced == 4.0
    with pytest.raises(ValueError, match=r"must have the same shapes and dtypes, got int32\[\] and float64\[\]"):
        jeuler.ensemble(lambda x: x, np.ones(4), reduce=Sum(), resume=tmp_path / "run")


def test_results_on_disk_can_be_indexed(tmp_path):
    found = jeuler.ensemble(lambda x: {"twice": 2 * x, "sum": x.sum()}, np.ones((5, 2)), batch=2, resume=tmp_path)
    assert found.results["twice"][4].tolist() == [2.0, 2.0]
    assert np.asarray(found.results["sum"]).tolist() == [2.0] * 5
    members = xarray.open_zarr(tmp_path / "results.zarr", consolidated=False)
    assert members.twice.dims == ("member", "twice_0")


def test_wrong_arguments_are_told():
    for wrong, match in (
        (lambda: jeuler.ensemble(trajectory, {"a": np.ones(3), "b": np.ones(4)}), "one leading axis"),
        (lambda: jeuler.ensemble(trajectory, 1.0), "one leading axis"),
        (lambda: jeuler.ensemble(trajectory, np.ones(3), reduce=3), "start, add, merge and value"),
        (lambda: jeuler.ensemble(3, np.ones(3)), "run must be a function"),
        (lambda: jeuler.ensemble(lambda x: x, np.ones(3), batch=0), "batch must be at least 1"),
        (lambda: jeuler.ensemble(lambda x: x, np.ones(3), resume=3), "resume must be the path of a folder"),
        (lambda: jeuler.ensemble(lambda x: x, np.ones(3), checkpoint_every=3), "checkpoint_every needs resume"),
        (lambda: jeuler.Quantiles((1.5,)), "from 0 to 1"),
        (lambda: jeuler.Quantiles(bounds=(1.0, 0.0)), "Quantiles.bounds"),
    ):
        with pytest.raises(ValueError, match=match):
            wrong()
