"""Every public object copies and pickles to an equal one, and shows itself on one screen."""

import copy
import dataclasses
import inspect
import pickle
import re

import cases
import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import objects
import pytest

import jeuler
import jeuler.plotting
import jeuler.scenes
from jeuler._core.describe import LINES, summary, values_of

WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "cloudpickle": lambda x: pickle.loads(cloudpickle.dumps(x)),
}
EACH = pytest.mark.parametrize("name", objects.OBJECTS)


def assert_equal(a, b):
    """The two are the same at every depth: classes, structures, dtypes, weak types and values."""
    assert type(a) is type(b)
    if isinstance(a, (np.ndarray, jax.Array)):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert getattr(a, "weak_type", None) == getattr(b, "weak_type", None)
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif type(a).__module__.startswith(("jeuler", "cases")):
        assert_equal(vars(a), vars(b))
    else:
        assert a is b or a == b or (a != a and b != b)


@EACH
@pytest.mark.parametrize("way", WAYS)
def test_a_copy_is_equal(name, way):
    x = objects.OBJECTS[name]()
    y = WAYS[way](x)
    assert_equal(x, y)
    if not inspect.isfunction(x):
        assert jax.tree.structure(x) == jax.tree.structure(y) or jax.tree_util.all_leaves([x])


def test_functions_of_one_line_are_cloudpickled():
    scene = jeuler.Scene((lambda t, position, velocity, mass: -position,), (jeuler.Death(lambda t, s: s.age > 1),))
    again = pickle.loads(cloudpickle.dumps(scene))
    np.testing.assert_array_equal(again.forces[0](0.0, jnp.ones((1, 2)), None, None), -np.ones((1, 2)))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", objects.STEPS)
def test_a_copied_step_steps_the_same(name, way):
    step = objects.OBJECTS[name]()
    again = WAYS[way](step)
    field, y = (lambda t, y, args: (y[1], -y[0])), (jnp.array([1.0]), jnp.array([0.5]))
    assert_equal(step(field, 0.0, y, 0.1, None), again(field, 0.0, y, 0.1, None))
    assert again.__name__ == step.__name__
    assert again.order == step.order
    assert hash(again) == hash(step)


@pytest.mark.parametrize("way", WAYS)
def test_a_copied_scene_runs_the_same(way):
    scene, state = objects.hanging()
    run, again = (jeuler.simulate(*pair, dt=0.01, num_steps=5) for pair in ((scene, state), WAYS[way]((scene, state))))
    assert_equal(run, again)


@pytest.mark.parametrize("way", WAYS)
def test_an_extra_field_is_kept(way):
    state = objects.hanging()[1].replace(noise=jnp.arange(4.0).reshape(2, 2))
    assert_equal(state.noise, WAYS[way](state).noise)


def test_an_empty_state_has_no_fields_and_says_so():
    empty = object.__new__(jeuler.ParticleState)
    with pytest.raises(AttributeError, match="no field 'colour'"):
        empty.colour  # noqa: B018


def test_every_public_class_is_among_the_objects():
    made = set().union(*(cases.kinds_in(make()) for make in objects.OBJECTS.values()))
    classes = {name for name in jeuler.__all__ if inspect.isclass(getattr(jeuler, name))}
    assert classes <= made | {type(make()).__name__ for make in objects.OBJECTS.values()}
    shown = {name for name in jeuler.plotting.__all__ if inspect.isclass(getattr(jeuler.plotting, name))}
    assert shown | {"Setup", "Film"} <= set(objects.OBJECTS)


@EACH
def test_repr_fits_a_screen_and_says_no_numbers_of_arrays(name):
    text = repr(objects.OBJECTS[name]())
    assert len(text.splitlines()) <= LINES
    assert max(map(len, text.splitlines())) <= 200
    assert "Array(" not in text
    assert "array(" not in text


@pytest.mark.parametrize("name", [*objects.FORCES, *objects.EFFECTS, *objects.RESULTS])
def test_a_notebook_shows_a_table(name):
    if name == "Film":
        return  # its player: tests/plotting/test_render.py
    page = objects.OBJECTS[name]()._repr_html_()
    assert page.startswith("<div><b>")
    assert page.count("<tr>") == page.count("</tr>") < 40
    assert len(page) < 20_000


def test_repr_of_large_and_batched_things_fits_too():
    scene = jeuler.Scene(tuple(jeuler.Gravity([0.0, float(k)]) for k in range(100)))
    assert "... 94 more" in repr(scene)
    many = jax.vmap(lambda g: jeuler.Gravity(g))(jnp.zeros((50, 2)))
    assert repr(many) == "Gravity(acceleration=float64[50,2])"
    deep = {"a": {"b": [{"c": jnp.zeros(3)}] * 30}}
    assert len(summary([deep] * 50).splitlines()) <= LINES + 1


def test_repr_says_shapes_also_while_tracing():
    seen = []
    jax.jit(lambda x: seen.append((repr(jeuler.Gravity(x)), jeuler.Gravity(x)._repr_html_())) or x)(jnp.zeros(2))
    assert seen[0][0] == "Gravity(acceleration=float64[2])"
    assert "float64[2]" in seen[0][1]


def test_repr_says_shapes_of_what_has_no_values():
    assert repr(jax.eval_shape(lambda: jeuler.Lifetime(1.0))) == "Lifetime(duration=float64[])"


def rows_of(page):
    return [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in re.findall(r"<tr>(.*?)</tr>", page)]


def test_a_fit_of_springs_shows_value_error_and_unit():
    found = objects.OBJECTS["SpringFit"]()
    head, row = rows_of(found._repr_html_())
    assert head == ["parameter", "value", "standard error", "unit"]
    assert (row[0], row[3]) == ("ks", "N/m")
    assert float(row[1]) == pytest.approx(float(found.ks), rel=1e-5)
    assert float(row[2]) == pytest.approx(float(found.stderr["ks"]), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("SpringFit", "ks +[0-9.]+ +[0-9.e-]+ +N/m"),
        ("Fit", "unused +2 +inf"),
        ("Identifiability", "ks +[0-9.e-]+ +N/m"),
        ("FoundSprings", r"0 - 1 +[0-9.]+ \+- [0-9.e-]+ +[0-9.]+ \+- (inf|[0-9.e-]+) +[0-9.]+ \+- [0-9.e-]+"),
        ("WorkPrecision", "Euler +[0-9.]+ +[0-9]+ +[0-9]+ +[0-9.e-]+ +[0-9.e-]+"),
    ],
)
def test_what_was_found_is_read_in_a_terminal_too(name, line):
    assert re.search(f"^{line}$", repr(objects.OBJECTS[name]()), re.MULTILINE)


def test_a_fit_that_is_traced_or_a_batch_still_has_a_repr():
    found = objects.OBJECTS["SpringFit"]()
    seen = []
    jax.jit(lambda loss: seen.append(repr(dataclasses.replace(found, loss=loss))) or loss)(1.0)
    many = repr(dataclasses.replace(found, loss=jnp.zeros(2)))
    assert "params" in seen[0]
    assert "loss=float64[2]" in many


def test_a_fit_says_what_the_data_do_not_determine():
    page = objects.OBJECTS["Fit"]()._repr_html_()
    assert ["unused", "2", "inf", ""] in rows_of(page)
    assert "do not determine" in page


def test_a_solution_shows_span_steps_and_what_was_lost():
    rows = dict(row for row in rows_of(objects.OBJECTS["Solution"]()._repr_html_()) if len(row) == 2)
    assert rows["time"] == "0 to 0.06 s"
    assert rows["saved"] == "4 states"
    assert rows["finite"] == "every step"
    lost = jax.vmap(lambda y: jeuler.solve(lambda t, y, args: y * y, y, dt=0.5, num_steps=20))(jnp.array([0.0, 1.0]))
    rows = dict(rows_of(lost._repr_html_()))
    assert rows["saved"] == "21 states of each of 2 runs"
    assert (
        rows["finite"]
        == f"1 of 2 runs are not finite to the end; the first step that is not finite is {lost.first_nonfinite.max()}"
    )


def test_a_pool_shows_missed_births():
    scene = jeuler.Scene(effects=(jeuler.Emitter(100.0, [0.0, 0.0], [0.0, 1.0], max_births=2),))
    run = jeuler.simulate(scene, jeuler.empty_pool(3, 2), dt=0.01, num_steps=10, key=jax.random.key(0))
    assert dict(rows_of(run._repr_html_()))["missed births"] == "7"


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (np.zeros(0), ""),
        (np.array([1.5, np.nan]), "1.5, nan"),
        (np.arange(5), "0 to 4"),
        (np.array([True, False, True, True]), "3 of 4 true"),
        (np.array([1.0, np.inf, np.nan, 2.0]), "1 to 2, 1 inf, 1 NaN"),
        (np.full(4, np.nan), "4 NaN"),
    ],
)
def test_values_in_a_table(x, expected):
    assert values_of(x) == expected
