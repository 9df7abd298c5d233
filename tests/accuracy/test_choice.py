"""advise_method: what it ranks first is right, meets its target when run, and what cannot says why."""

import importlib.util
import math
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from published import published

import jeuler
from jeuler.accuracy.candidates import default_candidates, is_motion
from jeuler.accuracy.trials import Found

NAMES = {"diffrax": diffrax, "jeuler": jeuler}
EXPLICIT = {"euler_step": jeuler.euler_step, "rk4_step": jeuler.rk4_step}


def decay(t, y, args):
    return -y


def relative_error(y, exact):
    return np.linalg.norm(np.asarray(y) - exact) / np.linalg.norm(exact)


def test_all_steps_of_the_library_and_four_of_diffrax_are_ranked_where_none_are_given():
    names = {candidate.name for candidate in default_candidates(decay, jnp.float64(1.0), 0.0, None)}
    steps = {f"{name}_step" for name in ("euler", "heun", "rk4", "implicit_euler", "linearly_implicit_euler")}
    steps |= {"implicit_midpoint_step"}
    assert steps | {"solve_adaptive", "extrapolated_euler(4)", "solve_adaptive, linearly implicit"} <= names
    assert {f"diffrax.{name}" for name in ("Euler", "Heun", "Tsit5", "Kvaerno5")} <= names
    assert "symplectic_euler_step" not in names  # not a motion
    motion = default_candidates(lambda t, y, args: (y[1], -y[0]), (jnp.float64(1.0), jnp.float64(0.0)), 0.0, None)
    assert "symplectic_euler_step" in {candidate.name for candidate in motion}


def test_every_code_that_it_gives_meets_its_target():
    methods = {**EXPLICIT, "adaptive": None, "Tsit5": diffrax.Tsit5(), "Euler of diffrax": diffrax.Euler()}
    advice = jeuler.advise_method(decay, 1.0, t1=2.0, error=1e-2, methods=methods)
    assert all(row.code for row in advice.rows)
    assert advice.rows[0] is advice.best
    assert [row.seconds for row in advice.rows] == sorted(row.seconds for row in advice.rows)
    for row in advice.rows:
        solution = eval(row.code, {**NAMES, "f": decay, "y0": jnp.float64(1.0), "methods": methods})
        y = solution.ys[-1] if hasattr(solution, "ys") else solution.y[-1]
        error = relative_error(y, math.exp(-2.0))
        assert error <= 1e-2, row
        assert error == pytest.approx(row.error, rel=0.1, abs=1e-5)


def test_high_order_wins_on_a_smooth_problem_and_euler_has_its_price():
    f, y0, t0, t1, reference = published("DETEST_nonstiff_B5")
    advice = jeuler.advise_method(f, y0, t0=t0, t1=t1, error=1e-5, methods=EXPLICIT)
    best, euler = advice.rows
    assert best.name == "rk4_step"
    assert euler.seconds > 20 * best.seconds
    run = jeuler.solve(f, y0, t0=t0, dt=best.dt, num_steps=best.num_steps, step=best.step)
    assert relative_error(run.y[-1], reference) <= 1e-5
    assert euler.num_steps > 100_000
    assert "rk4_step" in advice.reason
    assert f"{best.num_steps:,} steps" in advice.reason


def test_a_stiff_problem_gets_a_stiff_method_and_explicit_ones_say_that_they_are_unstable(monkeypatch):
    f, y0, t0, t1, reference = published("MAZZIA_ROBER")
    both = [
        c for c in default_candidates(f, y0, t0, None) if c.name in ("rk4_step", "solve_adaptive, linearly implicit")
    ]
    monkeypatch.setattr("jeuler.accuracy.choice.default_candidates", lambda *given: both)
    advice = jeuler.advise_method(f, y0, t0=t0, t1=t1, error=1e-3)
    assert advice.best.name == "solve_adaptive, linearly implicit"
    run = eval(advice.best.code, {**NAMES, "f": f, "y0": y0})
    assert relative_error(run.y[-1], reference) <= 1e-3
    assert "unstable in all runs up to" in advice.rows[1].reason
    assert math.isnan(advice.rows[1].seconds)


def test_what_roundoff_forbids_is_said():
    advice = jeuler.advise_method(decay, jnp.float32(1.0), t1=1.0, error=1e-8, methods=EXPLICIT)
    assert advice.best is None
    assert all("roundoff in float32" in row.reason for row in advice.rows)


def test_a_scene_is_asked_for_its_symplectic_step_and_effects_left_out_are_named():
    scene = jeuler.Scene(
        (jeuler.Springs([[0, 1]], ks=40.0, kd=0.1, rest_length=1.0),),
        (jeuler.Collisions((jeuler.Plane([0.0], [1.0]),)),),
    )
    state = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    methods = {name: getattr(jeuler, name) for name in ("symplectic_euler_step", "euler_step")}
    advice = jeuler.advise_method(scene, state, t1=1.0, error=1e-2, methods=methods)
    assert advice.best.name == "symplectic_euler_step"
    assert "without Collisions" in advice.reason
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # effects left out are left out in the code too
        run = eval(advice.best.code, {**NAMES, "scene": scene, "state": state, "methods": methods})
    exact = jeuler.simulate(
        jeuler.Scene(scene.forces), state, dt=1 / 4096, num_steps=4096, step=jeuler.rk4_step, save_every=4096
    )
    last = [np.concatenate([np.ravel(x.y.position[-1]), np.ravel(x.y.velocity[-1])]) for x in (run, exact)]
    assert relative_error(*last) <= 1e-2


def test_only_a_motion_is_offered_the_symplectic_step():
    start = jnp.array([1.0, 0.0]), jnp.array([0.0, 0.0])
    pinned = jnp.array([1.0, 0.0])  # moves, does not
    assert is_motion(lambda t, y, args: (y[1], -y[0]), start, 0.0, None)
    assert is_motion(lambda t, y, args: (y[1] * pinned, -y[0]), start, 0.0, None)
    assert not is_motion(lambda t, y, args: (2 * y[1], -y[0]), start, 0.0, None)
    assert not is_motion(lambda t, y, args: -y, jnp.zeros(2), 0.0, None)


def driven(t, y, args):
    """Switched on and off each second; y(20) from y(0) = 110 solved piece by piece."""
    return jnp.where(jnp.floor(t) % 2 == 0, 55 - 1.5 * y, -0.5 * y)


def test_breaks_let_high_orders_have_their_way_with_a_switched_field():
    methods = {"rk4_step": jeuler.rk4_step}
    plain = jeuler.advise_method(driven, 110.0, t1=20.0, error=1e-4, methods=methods)
    known = jeuler.advise_method(driven, 110.0, t1=20.0, error=1e-4, methods=methods, breaks=range(21))
    best = known.best
    assert plain.best is None or plain.best.num_steps > 10 * best.num_steps
    run = eval(best.code, {**NAMES, "f": driven, "y0": jnp.float64(110.0), "methods": methods})
    assert abs(float(run.y[-1]) / 19.981344941683865 - 1) <= 1e-4


def test_without_diffrax_its_solvers_are_left_out_with_a_word(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "diffrax" else find(name, *rest)
    )
    monkeypatch.setattr("jeuler.accuracy.choice._Ranking.run_all", lambda self, candidates, final: _none(candidates))
    advice = jeuler.advise_method(decay, 1.0, t1=1.0, error=1e-2)
    assert "diffrax is not installed" in advice.reason
    assert not any(row.name.startswith("diffrax") for row in advice.rows)


def _none(candidates):
    return {c.name: Found(None, 0, math.nan, math.nan, "not run") for c in candidates}


def test_patience_bounds_what_is_begun():
    advice = jeuler.advise_method(decay, 1.0, t1=1.0, error=1e-2, methods=EXPLICIT, patience=1e-6)
    assert all("patience" in row.reason for row in advice.rows)
    assert "were not tried, as patience= was over" in advice.reason


def test_patience_lasts_longer_while_nothing_reaches_the_target_and_what_was_not_tried_is_said(monkeypatch):
    monkeypatch.setattr("jeuler.accuracy.choice._Ranking.spent", 2.0)
    advice = jeuler.advise_method(decay, 1.0, t1=1.0, error=1e-2, methods=EXPLICIT, patience=1.0)
    assert advice.best.name == next(iter(EXPLICIT))
    assert "1 of 2 methods were not tried, as patience= was over" in advice.reason


def test_where_no_reference_is_known_nothing_is_ranked():
    jumpy = lambda t, y, args: jnp.where(jnp.sin(1e6 * t * t) > 0, 50.0, -49.0)  # noqa: E731
    advice = jeuler.advise_method(jumpy, 1.0, t1=1.0, error=1e-9, methods=EXPLICIT)
    assert advice.best is None
    assert "no method can be judged" in advice.reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t1": 0.0}, "t1 must be later than t0=0"),
        ({"error": 0.0}, "error must be greater than 0"),
        ({"patience": 0.0}, "patience must be greater than 0"),
        ({"methods": [jeuler.euler_step]}, "methods must be a dict"),
        ({"methods": {"Euler": "euler"}}, "must be a step"),
        ({"methods": {"Tsit5": diffrax.Tsit5}}, "must be a step or a diffrax solver"),
        ({"breaks": "now"}, "breaks must be times"),
    ],
)
def test_bad_input_is_told(change, message):
    with pytest.raises(ValueError, match=message):
        jeuler.advise_method(decay, 1.0, **({"t1": 1.0, "error": 1e-2} | change))


def test_traced_values_are_told():
    with pytest.raises(ValueError, match="advise_method must be called with values, got traced ones"):
        jax.jit(lambda t1: jeuler.advise_method(decay, 1.0, t1=t1, error=1e-2))(1.0)


def test_it_shows_itself_as_a_table():
    advice = jeuler.advise_method(decay, 1.0, t1=1.0, error=1e-3, methods=EXPLICIT)
    text, markdown, page = repr(advice), advice.to_markdown(), advice._repr_html_()
    for shown in (text, markdown, page):
        assert "rk4_step" in shown
        assert "euler_step" in shown
    assert advice.reason in text
    assert len(markdown.splitlines()) == 4
    assert "<table>" in page
