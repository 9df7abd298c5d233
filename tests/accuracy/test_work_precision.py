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
from jeuler.accuracy import Compensated, WorkPrecision, work_precision
from jeuler.accuracy.table import EMPTY_ROW, fitted_order, mark_pareto, roundoff_floor
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import linearly_implicit_euler_step

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
        tolerances=(1e-5,),
        repeats=2,
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


def test_the_table_can_be_written_read_and_drawn(table, tmp_path):
    table.to_csv(tmp_path / "table.csv")
    with open(tmp_path / "table.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert [row["method"] for row in read] == [row["method"] for row in table.rows]
    assert [float(row["error_final"]) for row in read] == [row["error_final"] for row in table.rows]
    assert [tuple(map(float, row["run_seconds"].split())) for row in read] == [r["run_seconds"] for r in table.rows]
    text = table.to_markdown()
    assert len(text.splitlines()) == 2 + 6 * 2 + 2
    assert "float32" in text.splitlines()[0]
    assert "float64" in text.splitlines()[0]
    axes = table.plot()
    assert np.shape(axes) == (2, 2)
    written = {text.get_text() for text in axes[1, 0].texts}
    assert {"euler", "rk4", "Tsit5", "Tsit5, adaptive"} <= written
    _, ax = plt.subplots()
    assert table.plot(ax) is ax
    plt.close("all")


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
    assert skipped["num_steps"] == 1_000_000_000


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
        {"run_seconds_min": s, "error_final": e, "error_final_relative": e}
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
            "error_final_relative": error, "run_seconds_min": seconds,
        }  # fmt: skip

    rows = [row(0.1, 1e-2, 1.0), row(0.05, 5e-3, 2.0), row(0.025, 2.5e-3, 3.0), row(0.0125, 1e-9, 4.0)]
    mark_pareto(rows, 1e-6)
    assert [r["pareto"] for r in rows] == [True, True, True, False]
    table = WorkPrecision(rows, {}, 1e-6, (0.0, 1.0))
    assert table.summary[0].order == pytest.approx(1.0)
