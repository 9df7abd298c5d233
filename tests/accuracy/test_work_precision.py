"""Work-precision tables: errors against exact solutions, orders, floors, gradients, rows that failed, the figure."""

import csv
import math

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jeuler
from jeuler.accuracy import Compensated, Method, WorkPrecision, work_precision
from jeuler.accuracy.runs import FixedRun, fixed_program
from jeuler.accuracy.table import EMPTY_ROW, fitted_order, mark_pareto, roundoff_floor
from jeuler.accuracy.timing import counting
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import implicit_euler_step, linearly_implicit_euler_step

matplotlib.use("Agg")


def oscillator(t, y, ks):
    return y[1], -ks * y[0]


def exact(t, ks=4.0):
    return np.cos(np.sqrt(ks) * t), -np.sqrt(ks) * np.sin(np.sqrt(ks) * t)


@pytest.fixture(scope="module")
def table():
    return work_precision(
        oscillator,
        (1.0, 0.0),
        t1=2.0,
        dts=[0.02, 0.01],
        steps={
            "euler": jeuler.euler_step,
            "compensated": Compensated(jeuler.euler_step),
            "rk4": jeuler.rk4_step,
            "linearly implicit": linearly_implicit_euler_step,
            "extrapolated": extrapolated_euler(4),
            "Tsit5": diffrax.Tsit5(),
        },
        args=4.0,
        reference=exact,
        dtypes=("float32", "float64"),
        tolerances=[(1e-5, 1e-8)],
        repeats=2,
        problem="oscillator",
    )


def rows(table, **wanted):
    return [row for row in table.rows if all(row[key] == value for key, value in wanted.items())]


def test_errors_are_those_of_a_run_beside_the_exact_solution(table):
    run = jeuler.solve(oscillator, (1.0, 0.0), dt=0.01, num_steps=200, args=4.0, save_every=4)
    error = np.hypot(*(np.asarray(y) - e for y, e in zip(run.y, exact(np.asarray(run.t)), strict=True)))
    size = np.hypot(*exact(np.asarray(run.t)))
    (row,) = rows(table, method="euler", dtype="float64", num_steps=200)
    assert row["dt"] == pytest.approx(0.01)
    assert row["error_final"] == pytest.approx(error[-1], rel=1e-9)
    assert row["error_max"] == pytest.approx(error.max(), rel=1e-9)
    mean = np.sqrt(np.trapezoid(error**2, run.t) / 2.0)
    assert row["error_l2"] == pytest.approx(mean, rel=1e-9)
    assert row["error_final_relative"] == pytest.approx(error[-1] / size[-1], rel=1e-9)
    assert row["error_max_relative"] == pytest.approx(error.max() / size.max(), rel=1e-9)


def test_every_method_has_every_dt_in_every_precision(table):
    assert len(table.rows) == 2 * (6 * 2 + 2)  # two methods can also choose their own steps
    assert all(set(row) == set(EMPTY_ROW) for row in table.rows)
    assert all(row["reason"] == "" and len(row["run_seconds"]) == 2 for row in table.rows)
    assert all(row["run_seconds_min"] == min(row["run_seconds"]) > 0 < row["compile_seconds"] for row in table.rows)


def test_evaluations_are_counted(table):
    def count(method, num_steps):
        return rows(table, method=method, dtype="float64", num_steps=num_steps)[0]["evaluations"]

    assert count("euler", 200) == 200
    assert count("rk4", 200) == 800
    assert count("Tsit5", 200) == 200 * 6 + 1  # the first and last stage are one evaluation
    assert count("extrapolated", 200) == 200 * 4 * 3  # four substeps of three lanes
    assert count("linearly implicit", 200) == 200


def test_evaluations_of_an_adaptive_run_are_those_of_its_steps_tried(table):
    for dtype in ("float32", "float64"):
        (tsit5,) = rows(table, method="Tsit5", dtype=dtype, rtol=1e-5)
        assert tsit5["evaluations"] == 6 * tsit5["num_steps"] + 1
        (ours,) = rows(table, method="extrapolated", dtype=dtype, rtol=1e-5)
        assert ours["evaluations"] == 13 * ours["num_steps"] + 1  # 4 x 3 lanes and the estimate; the first guess of dt


def test_a_step_that_iterates_is_counted_while_it_does():
    counted, read = counting(lambda t, y, args: -(y**3))
    dts = [0.25, 1 / 64]
    table = work_precision(lambda t, y, args: -(y**3), 1.0, t1=1.0, dts=dts, steps=[implicit_euler_step], repeats=1)
    for row, n in zip(table.rows, (4, 64), strict=True):
        jeuler.solve(counted, 1.0, dt=1 / n, num_steps=n, step=implicit_euler_step)
        assert row["evaluations"] == read()
    assert table.rows[0]["evaluations"] / 4 > table.rows[1]["evaluations"] / 64  # longer steps need more iterations


def test_orders_are_found(table):
    order = {(s.method, s.dtype): s.order for s in table.summary}
    assert order["euler", "float64"] == pytest.approx(1, abs=0.1)
    assert order["rk4", "float64"] == pytest.approx(4, abs=0.1)
    assert order["extrapolated", "float64"] == pytest.approx(4, abs=0.1)
    assert order["Tsit5", "float64"] == pytest.approx(5, abs=0.3)


def test_stability_limits_stand_beside_the_methods(table):
    assert table.stability_limits["euler"] == 0.0
    assert table.stability_limits["rk4"] == pytest.approx(math.sqrt(2), rel=1e-6)
    assert table.stability_limits["linearly implicit"] == math.inf
    assert math.isnan(table.stability_limits["Tsit5"])


def equal(a, b):
    return a == b or (a != a and b != b)


def test_the_table_can_be_written_read_back_and_drawn(table, tmp_path):
    table.to_csv(tmp_path / "table.csv")
    with open(tmp_path / "table.csv", newline="") as file:
        assert csv.DictReader(file).fieldnames == list(EMPTY_ROW)
    read = WorkPrecision.from_csv(tmp_path / "table.csv")
    assert all(
        type(a[key]) is type(b[key]) and equal(a[key], b[key])
        for a, b in zip(read.rows, table.rows, strict=True)
        for key in EMPTY_ROW
    )
    assert read.to_markdown() == table.to_markdown()
    text = table.to_markdown()
    assert len(text.splitlines()) == 2 + 6 * 2 + 2
    assert "float32" in text.splitlines()[0]
    assert "float64" in text.splitlines()[0]
    axes = table.plot()
    assert np.shape(axes) == (2, 2)
    written = {text.get_text() for text in axes[1, 0].texts}
    assert {"euler", "rk4", "Tsit5", "Tsit5, adaptive"} <= written
    plt.close("all")


def test_the_figure_has_the_axes_asked_for(table):
    _, ax = plt.subplots()
    assert table.plot(ax) is ax
    assert ax.get_xlabel() == "time of one run"
    axes = table.where(dtype="float64").plot(against=("evaluations", "dt"), error="max")
    assert axes.shape == (1, 2)
    assert [each.get_xlabel() for each in axes[0]] == ["evaluations of f", "dt, s"]
    assert axes[0, 0].get_ylabel() == "largest relative error"
    (line,) = [line for line in axes[0, 0].lines if len(line.get_xdata()) == 2 and 800 in line.get_xdata()]
    drawn = rows(table, method="rk4", dtype="float64")
    assert list(line.get_xdata()) == [row["evaluations"] for row in drawn]
    assert list(line.get_ydata()) == [row["error_max_relative"] for row in drawn]
    for change in ({"against": "minutes"}, {"error": "mean"}, {"ax": (ax, ax, ax)}):
        with pytest.raises(ValueError, match=f"{next(iter(change))} must be"):
            table.plot(**change)
    plt.close("all")


@pytest.mark.optimised
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.rk4_step, linearly_implicit_euler_step])
@pytest.mark.parametrize("compensated", [False, True])
def test_one_program_for_all_numbers_of_steps_gives_the_very_states_of_solve(step, dtype, compensated):
    if compensated and not hasattr(step, "increment"):
        return
    y0, args = (jnp.asarray(1.0, dtype), jnp.asarray(0.0, dtype)), jnp.asarray(4.0, dtype)
    program = jax.jit(fixed_program(Method(step, compensated=compensated), oscillator, 0.5, 101))
    for num_steps in (1, 20, 101):
        run = FixedRun(0.5, 0.3 / num_steps, num_steps, points=8)
        states, lost, taken = program(y0, args, *run.inputs(dtype, 101))
        expected = jeuler.solve(
            oscillator, y0, dt=run.dt, num_steps=num_steps, t0=0.5, args=args, step=step, compensated=compensated
        )
        kept = np.append(0, run.ends)
        for ours, theirs in zip(states, expected.y, strict=True):
            np.testing.assert_array_equal(ours[: len(kept)], theirs[kept])
        assert (int(lost), int(taken)) == (-1, num_steps)
        np.testing.assert_allclose(run.times, expected.t[kept], rtol=1e-6)
    assert program._cache_size() == 1


@pytest.mark.parametrize("num_steps", [1, 2, 63, 64, 65, 100, 101, 128, 1999])
def test_errors_are_taken_over_the_whole_run_whatever_the_number_of_steps(num_steps):
    ends = FixedRun(0.0, 1.0, num_steps, points=64).ends
    assert ends[-1] == num_steps
    assert min(num_steps, 32) <= len(ends) <= 64
    gaps = np.diff(ends, prepend=0)
    assert gaps.min() >= 1
    assert gaps.max() <= gaps.min() + 1


def test_an_error_that_comes_and_goes_is_seen_by_the_largest_and_the_mean_of_adaptive_runs_too():
    bump = lambda t: np.exp(-50 * (t - 0.5) ** 2)  # noqa: E731
    slope = lambda t, y, args: -20 * y + (20 - 100 * (t - 0.5)) * jnp.exp(-50 * (t - 0.5) ** 2)  # noqa: E731
    table = work_precision(
        slope, float(bump(0.0)), t1=1.0, dts=[1 / 53], steps={"euler": jeuler.euler_step,
        "extrapolated": extrapolated_euler(3), "Bosh3": diffrax.Bosh3()}, tolerances=[1e-3], reference=bump, repeats=1,
    )  # fmt: skip
    euler = rows(table, method="euler")[0]
    own = jeuler.solve(slope, float(bump(0.0)), dt=1 / 53, num_steps=53)
    assert euler["error_max"] == pytest.approx(np.abs(own.y - bump(own.t)).max(), rel=1e-6)
    for name in ("extrapolated", "Bosh3"):
        (row,) = rows(table, method=name, rtol=1e-3)
        assert 3e-2 > row["error_max"] > 1.5 * row["error_l2"] > 3 * row["error_final"] > 0


def test_relative_and_absolute_tolerance_are_two():
    def run(rtol, atol):
        table = work_precision(
            lambda t, y, args: -y, 1.0, t1=20.0, dts=[20.0], steps={"Tsit5": Method(diffrax.Tsit5(), dts=())},
            tolerances=[(rtol, atol)], reference=lambda t: np.exp(-t), repeats=1,
        )  # fmt: skip
        (row,) = table.rows
        assert (row["rtol"], row["atol"], row["dt"]) == (rtol, atol, pytest.approx(math.nan, nan_ok=True))
        return row

    assert run(1e-6, 0.0)["error_final_relative"] < 1e-4  # of 2e-9
    assert run(1e-6, 1e-3)["error_final_relative"] > 1e-1


def test_a_norm_of_ones_own_measures_states_and_the_trust_in_the_reference():
    norm = lambda y: 3 * jnp.abs(y[0])  # noqa: E731
    make = lambda reference: work_precision(  # noqa: E731
        oscillator, (1.0, 0.0), t1=1.0, dts=[0.1], steps=[jeuler.euler_step], args=4.0, reference=reference, norm=norm,
        repeats=1, dtypes=("float32",),
    )  # fmt: skip
    run = jeuler.solve(oscillator, (1.0, 0.0), dt=0.1, num_steps=10, args=4.0)
    error = 3 * np.abs(np.asarray(run.y[0]) - exact(np.asarray(run.t))[0])
    for table in map(make, (exact, None)):
        (row,) = table.rows
        assert row["error_final"] == pytest.approx(error[-1], rel=1e-4)
        assert row["error_max"] == pytest.approx(error.max(), rel=1e-4)
        assert row["error_final_relative"] == pytest.approx(error[-1] / (3 * abs(exact(1.0)[0])), rel=1e-4)
    assert 0 < table.reference_error < 1e-8


def test_a_method_has_sizes_tolerances_and_options_of_its_own():
    table = work_precision(
        lambda t, y, args: jnp.where(t < 0.3, 0.0, args), 0.0, t1=1.0, dts=[0.25], args=2.0, repeats=1,
        reference=lambda t: 2 * np.maximum(t - 0.3, 0), tolerances=[1e-2], steps={
            "plain": jeuler.euler_step,
            "broken": Method(jeuler.euler_step, dts=[0.5, 0.25], options={"breaks": [0.3]}),
            "adaptive": Method(extrapolated_euler(2), dts=(), options={"breaks": [0.3], "dt0": 0.05}),
            "fixed Tsit5": Method(diffrax.Tsit5(), tolerances=()),
            "PI Tsit5": Method(diffrax.Tsit5(), dts=(), tolerances=[1e-4],
                options={"controller": lambda rtol, atol: diffrax.PIDController(rtol, atol, pcoeff=0.3, icoeff=0.4)}),
        },
    )  # fmt: skip
    found = {(row["method"], row["dt"], row["rtol"]): row for row in table.rows if row["dt"] == row["dt"]}
    assert [key[:2] for key in found] == [
        ("plain", 0.25), ("broken", 0.5), ("broken", 0.25), ("fixed Tsit5", 0.25),
    ]  # fmt: skip
    assert [row["rtol"] for row in table.rows if row["rtol"] == row["rtol"]] == [1e-2, 1e-4]
    assert rows(table, method="plain")[0]["error_final"] == pytest.approx(0.4)
    assert all(row["error_max"] < 1e-5 for row in rows(table, method="broken"))
    assert rows(table, method="adaptive")[0]["error_max"] < 1e-5


def test_a_method_can_be_added_later_and_problems_stand_side_by_side(table, tmp_path):
    def more(**change):
        given = {"t1": 2.0, "dts": [0.02], "steps": {"heun": jeuler.heun_step}, "args": 4.0, "reference": exact}
        return work_precision(oscillator, (1.0, 0.0), **({"repeats": 1, "problem": "oscillator"} | given | change))

    table.to_csv(tmp_path / "table.csv")
    both = WorkPrecision.from_csv(tmp_path / "table.csv") + more()
    assert [s.method for s in both.summary][-1] == "heun"
    assert len(both.rows) == len(table.rows) + 1
    again = both + more(repeats=3)
    assert len(again.rows) == len(both.rows)  # measured again: the later one
    assert len(again.rows[-1]["run_seconds"]) == 3
    fast = [dict(row, run_seconds_min=0.0) | {"run_seconds_min": 1e-12} for row in more().rows]
    assert [row["method"] for row in (both + WorkPrecision(fast)).rows if row["pareto"]][-1] == "heun"

    decay = work_precision(
        lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1], steps={"heun": jeuler.heun_step}, repeats=1,
        reference=lambda t: np.exp(-t), problem="decay",
    )  # fmt: skip
    two = table + decay
    assert two.problems == ["oscillator", "decay"]
    assert any(row["pareto"] for row in two.rows if row["problem"] == "decay")  # each problem has its own front
    assert two.to_markdown().startswith("| problem | method |")
    assert two.where(problem="decay").interval == (0.0, 1.0)
    with pytest.raises(ValueError, match=r"write table.where\(problem=...\).stability_limits"):
        _ = two.stability_limits
    assert two.plot().shape == (3, 2)
    plt.close("all")
    for other in (more(t1=1.0), more(args=5.0, reference=lambda t: exact(t, 5.0))):
        with pytest.raises(ValueError, match="give the other one a name"):
            table + other


def test_a_file_that_is_no_such_table_is_told(tmp_path):
    (tmp_path / "other.csv").write_text("method,seconds\neuler,1\n")
    with pytest.raises(ValueError, match=r"other.csv must have the columns that WorkPrecision.to_csv writes"):
        WorkPrecision.from_csv(tmp_path / "other.csv")
    WorkPrecision([EMPTY_ROW | {"method": "a"}]).to_csv(tmp_path / "own.csv")
    text = (tmp_path / "own.csv").read_text()
    (tmp_path / "own.csv").write_text(text.replace("False", "perhaps"))
    with pytest.raises(ValueError, match=r"own.csv, line 2: expected True or False, got 'perhaps'"):
        WorkPrecision.from_csv(tmp_path / "own.csv")


def test_without_a_reference_diffrax_gives_one_and_says_how_far_to_trust_it():
    table = work_precision(oscillator, (1.0, 0.0), t1=1.0, dts=[0.1], steps=[jeuler.rk4_step], args=4.0, repeats=1)
    (row,) = table.rows
    assert row["method"] == "rk4"
    run = jeuler.solve(oscillator, (1.0, 0.0), dt=0.1, num_steps=10, args=4.0, step=jeuler.rk4_step)
    error = np.hypot(*(float(y[-1]) - e for y, e in zip(run.y, exact(1.0), strict=True)))
    assert row["error_final"] == pytest.approx(error, rel=1e-5)
    assert table.reference_error < 1e-9


def test_gradient_is_compared_timed_and_weighed():
    table = work_precision(
        lambda t, y, rate: -rate * y,
        1.0,
        t1=1.0,
        dts=[0.02, 0.01],
        steps={"euler": jeuler.euler_step},
        args=2.0,
        reference=lambda t: np.exp(-2 * t),
        gradient=lambda y: y**2,
        repeats=2,
    )
    coarse, fine = table.rows
    true = -2 * np.exp(-4)  # d/drate exp(-2 rate t) at t = 1
    for row, n in ((coarse, 50), (fine, 100)):
        stepped = -2 * (1 - 2 / n) ** (2 * n - 1)
        assert row["gradient_error"] == pytest.approx(abs(stepped - true), rel=1e-6)
        assert row["gradient_error_relative"] == pytest.approx(abs(stepped / true - 1), rel=1e-6)
        assert len(row["gradient_seconds"]) == 2
        assert row["gradient_bytes"] > 0
    assert "gradient error" in table.to_markdown()


def test_a_run_that_blows_up_is_a_row_with_its_reason():
    table = work_precision(
        lambda t, y, args: y**2,
        1.0,
        t1=3.0,
        dts=[0.01],
        steps={"euler": jeuler.euler_step},
        reference=0.0,
        repeats=1,
    )
    (row,) = table.rows
    assert math.isnan(row["error_final"])
    assert row["reason"].startswith("blew up: not finite at step ")
    assert "blew up" in table.to_markdown()


def test_a_run_that_would_take_too_long_is_a_row_with_its_reason():
    table = work_precision(
        lambda t, y, args: -y,
        1.0,
        t1=1.0,
        dts=[1e-3, 1e-9],
        steps={"euler": jeuler.euler_step},
        reference=lambda t: np.exp(-t),
        repeats=1,
        timeout=0.5,
    )
    ran, skipped = table.rows
    assert math.isfinite(ran["error_final"])
    assert math.isnan(skipped["error_final"])
    assert "more than timeout=0.5 s" in skipped["reason"]
    assert skipped["num_steps"] == skipped["evaluations"] == 1_000_000_000


@pytest.mark.optimised
def test_roundoff_floor_is_found_in_float32_and_falls_with_compensated_sums():
    table = work_precision(
        lambda t, y, args: -y,
        1.0,
        t1=1.0,
        dts=[2.0**-k for k in range(8, 21, 2)],
        steps={"plain": jeuler.euler_step, "compensated": Compensated(jeuler.euler_step)},
        reference=lambda t: np.exp(-t),
        dtypes=("float32",),
        repeats=1,
    )
    plain, compensated = table.summary
    assert plain.order == pytest.approx(1, abs=0.1)
    assert 1e-7 < plain.roundoff_floor < 1e-4
    assert 2.0**-20 < plain.floor_dt < 2.0**-12
    assert math.isnan(compensated.roundoff_floor)  # still falling
    assert compensated.order == pytest.approx(1, abs=0.1)
    assert table.rows[-1]["error_final"] < 3e-7


def test_floor_order_and_front_of_made_up_numbers():
    dt = 2.0 ** -np.arange(12.0)
    error = np.maximum(1e-3 * dt**2, 1e-8)
    floor, floor_dt = roundoff_floor(dt, error)
    assert (floor, floor_dt) == (1e-8, 2.0**-9)
    assert fitted_order(dt, error, error, floor, floor_dt) == pytest.approx(2, abs=1e-9)
    assert math.isnan(roundoff_floor(dt, dt)[0])
    made = [
        EMPTY_ROW | {"run_seconds_min": s, "error_final": e, "error_final_relative": e, "reference_error": 0.0}
        for s, e in ((1.0, 0.1), (2.0, 0.2), (3.0, 0.01), (0.5, 40.0), (4.0, math.nan))
    ]
    mark_pareto(made)
    assert [row["pareto"] for row in made] == [True, False, True, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t1": -1.0}, "t1 must be later than t0"),
        ({"dts": []}, "dts must name at least one"),
        ({"dts": [0.1, -0.1]}, "each of dts must be greater than 0"),
        ({"steps": {}}, "steps must name at least one"),
        ({"steps": {"x": 3}}, r"steps\['x'\] must be a step"),
        ({"dtypes": ["float16"]}, "dtypes must be float32 or float64"),
        ({"repeats": 0}, "repeats must be at least 1"),
        ({"reference": np.ones(5)}, "reference must have the numbers of y0"),
        ({"tolerances": [(1e-3, 1e-3, 1e-3)]}, r"tolerances must be a list of numbers above 0 or of pairs"),
        ({"tolerances": [(1e-3, -1e-3)]}, r"tolerances must be .*, got atol = -0.001"),
        ({"tolerances": [0.0]}, r"tolerances must be a list of numbers above 0"),
        ({"tolerances": ["a"]}, r"rtol of each of tolerances must be one finite real number"),
        ({"norm": 2}, "norm must be a function"),
        ({"norm": lambda y: jnp.ones(2)}, "norm must return one number that is at least 0"),
        ({"norm": lambda y: -1.0}, "norm must return one number that is at least 0"),
        ({"points": 0}, "points must be at least 1"),
        ({"problem": 3}, "problem must be a string"),
        ({"steps": {"x": Method(jeuler.euler_step, tolerances=[1e-3])}}, "does not choose its own dt"),
        ({"steps": {"x": Method(jeuler.euler_step, dts=())}}, "must name at least one run"),
        ({"steps": {"x": Method(jeuler.euler_step, dts=[-1.0])}}, r"each of steps\['x'\].dts must be greater than 0"),
        ({"steps": {"x": Method(jeuler.euler_step, options={"adjoint": 1})}}, r"options must be a dict of breaks"),
        ({"steps": {"x": Compensated(jeuler.implicit_euler_step)}}, "must be an explicit step with an .increment"),
    ],
)
def test_bad_input_is_told(change, message):
    given = {
        "t1": 1.0,
        "dts": [0.1],
        "steps": {"euler": jeuler.euler_step},
        "reference": lambda t: np.exp(-t),
    }
    with pytest.raises(ValueError, match=message):
        work_precision(lambda t, y, args: -y, 1.0, **(given | change))


def test_traced_values_are_told():
    def of_start(y0):
        return work_precision(lambda t, y, args: -y, y0, t1=1.0, dts=[0.1], steps={"euler": jeuler.euler_step})

    with pytest.raises(ValueError, match="work_precision must be called with values, got traced ones"):
        jax.jit(of_start)(1.0)


def test_x64_is_left_as_it_was(table):
    assert jax.config.jax_enable_x64
    assert jnp.ones(1).dtype == jnp.float64


def test_errors_below_that_of_the_reference_count_for_nothing():
    def row(dt, error, seconds):
        return EMPTY_ROW | {
            "method": "a", "dtype": "float64", "dt": dt, "num_steps": round(1 / dt), "error_final": error,
            "error_final_relative": error, "run_seconds_min": seconds, "reference_error": 1e-6,
        }  # fmt: skip

    rows = [row(0.1, 1e-2, 1.0), row(0.05, 5e-3, 2.0), row(0.025, 2.5e-3, 3.0), row(0.0125, 1e-9, 4.0)]
    mark_pareto(rows)
    assert [r["pareto"] for r in rows] == [True, True, True, False]
    table = WorkPrecision(rows)
    assert table.summary[0].order == pytest.approx(1.0)
