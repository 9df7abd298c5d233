"""From the file that a phone, a camera or a logger writes to the right ks and kd by one command."""

import json

import numpy as np
import pytest
from commands import quirks

from jeuler.__main__ import main, parser
from jeuler.commands.selection import recordings_in, select


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quirks.write(tmp_path)
    return tmp_path


def selected(*arguments):
    told = parser().parse_args(["fit", *map(str, arguments)])
    return select(recordings_in(told.files[0], told), told)


def fitted(*arguments):
    assert main(["fit", *map(str, arguments), "--json", "out.json"]) == 0
    with open("out.json") as file:
        return json.load(file)


@pytest.mark.parametrize("name", quirks.recordings())
def test_columns_units_and_clock_are_understood(folder, name):
    measured = selected(name)
    wanted = quirks.recordings()[name][1]
    assert measured.names == wanted
    np.testing.assert_allclose(measured.times, quirks.T, atol=1e-5)
    if name == "phyphox.csv":
        assert (measured.quantity, measured.unit) == ("acceleration", "m/s^2")
        np.testing.assert_allclose(measured.positions[:, 0, 1], quirks.acceleration(seed=2), rtol=1e-6, atol=1e-6)
        assert ("Absolute acceleration (m/s^2)", "an absolute value, which has lost the sign") in measured.left_out
        return
    assert (measured.quantity, measured.unit) == ("position", "m")
    x = quirks.swing(phase=1.0, seed=2) if name == "pasco.csv" else quirks.swing()
    seen = np.isfinite(measured.positions[:, 0, 0])
    assert seen.sum() == (235 if name == "missing.csv" else 250)
    np.testing.assert_allclose(measured.positions[seen, 0, 0], x[seen], atol=1e-6)
    assert not measured.warnings


@pytest.mark.parametrize(
    ("name", "left_out"),
    [
        ("percent.txt", ["v"]),
        ("vernier.csv", ["Data Set 1:Velocity(m/s)", "Data Set 1:Acceleration(m/s²)"]),
        ("index.csv", ["column1"]),
        ("commas.csv", ["Position, Ch 3+4 (m)"]),
    ],
)
def test_what_is_left_out_is_said(folder, name, left_out):
    assert [column for column, _ in selected(name).left_out] == left_out


def test_runs_are_listed_and_chosen(folder):
    assert any(
        "Run 2 of 3 is used; the others are 1 (200 rows), 3 (150 rows)" in n for n in selected("pasco.csv").notes
    )
    assert len(selected("pasco.csv", "--run", 3).times) == 150
    assert selected("pasco.csv", "--run", "all").positions.shape == (250, 3, 1)
    assert len(selected("stacked.csv", "--run", 1).times) == 120
    assert any("The clock starts again at line 122" in note for note in selected("stacked.csv").notes)


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        ("Position, Ch 3+4 (m)", ["Position, Ch 3+4 (m)"]),
        ('"Position, Ch 3+4 (m)"', ["Position, Ch 3+4 (m)"]),
        ("Position, Ch 1+2 (m),Position, Ch 3+4 (m)", ["Position, Ch 1+2 (m)", "Position, Ch 3+4 (m)"]),
    ],
)
def test_names_with_commas_and_quotes(folder, columns, names):
    assert selected("commas.csv", "--columns", columns).names == names


def test_corrections(folder):
    (folder / "bare.csv").write_text("a,b,c\n" + quirks.table(1000 * quirks.T, 1000 * quirks.swing(), 0 * quirks.T))
    measured = selected("bare.csv", "--time", "a", "--columns", "b", "--unit", "a=ms,b=mm", "--from", 1, "--to", 5)
    assert measured.names == ["b"]
    np.testing.assert_allclose(measured.times, quirks.T[25:126], atol=1e-6)
    np.testing.assert_allclose(measured.positions[:, 0, 0], quirks.swing()[25:126], atol=1e-6)
    velocity = selected("vernier.csv", "--observe", "velocity")
    assert velocity.names == ["Data Set 1:Velocity(m/s)"]


def test_a_name_or_clock_without_unit_is_a_warning(folder):
    (folder / "bare.csv").write_text("t,value\n" + quirks.table(40 * np.arange(250), quirks.swing()))
    first, second = selected("bare.csv").warnings
    assert "its steps of 40 are taken as seconds. If they are milliseconds, give --unit t=ms." in first
    assert "Neither name nor unit says what value is" in second


def test_numbers_too_large_for_their_unit_are_a_warning(folder):
    (folder / "bare.csv").write_text(
        "t,y,theta\n" + quirks.table(quirks.T, quirks.acceleration(), 900 * quirks.swing())
    )
    (warning,) = selected("bare.csv", "--columns", "y").warnings
    assert "y: no unit, and an extent of" in warning
    assert "give --unit, such as --unit y=m/s^2" in warning
    assert selected("bare.csv", "--columns", "y", "--unit", "y=m/s^2").quantity == "acceleration"
    (warning,) = selected("bare.csv", "--columns", "theta").warnings
    assert "--unit theta=deg" in warning
    assert selected("bare.csv", "--columns", "theta", "--unit", "theta=deg").warnings == ()


def test_oversampled_rows_are_averaged_and_it_is_said(folder):
    t = np.arange(200_000) / 5_000
    np.savetxt("fast.csv", np.column_stack([t, quirks.swing(t)]), delimiter=",", header="t,x", comments="", fmt="%.6f")
    measured = selected("fast.csv")
    assert 15_000 < len(measured.times) <= 21_000
    assert any("Of 200000 rows every 10 are averaged to one" in note for note in measured.notes)


@pytest.mark.parametrize("name", ["vernier.csv", "phyphox.csv"])
def test_fit_by_the_plain_command(folder, name, capsys):
    told = fitted(name, "--mass", 0.25)
    spring = told["springs"][0]
    np.testing.assert_allclose(spring["ks"], quirks.KS, rtol=0.005)
    np.testing.assert_allclose(spring["kd"], quirks.KD, rtol=0.05)
    assert abs(spring["ks"] - quirks.KS) < 4 * spring["ks_stderr"]
    assert told["warnings"] == []
    text = capsys.readouterr().out
    for word in (
        told["quantity"],
        told["columns"][0],
        told["unit"],
        "from 0 to 9.96 s",
        "left out",
        "equation",
        "trust",
    ):
        assert word in text
    assert (told["schema"], told["version"]) == ("jeuler.fit", 1)


def test_all_runs_in_one_fit(folder):
    told = fitted("pasco.csv", "--mass", 0.25, "--run", "all")
    assert len(told["springs"]) == 1
    np.testing.assert_allclose(told["springs"][0]["ks"], quirks.KS, rtol=0.005)
    np.testing.assert_allclose(told["springs"][0]["kd"], quirks.KD, rtol=0.05)
    assert told["samples"] == 600


def test_two_carts_from_their_own_rests(folder):
    """Signed springs: crossing zero is no kink; damping near 0 is not lost."""
    from scipy.linalg import expm

    mass, (left, middle, right), damping = np.array([[0.4], [1.0]]), (3.1, 31.5, 3.2), 0.02
    stiffness = np.array([[left + middle, -middle], [-middle, right + middle]])
    system = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness / mass, -damping * np.eye(2) / mass]])
    step, state, rows = expm(system / 30), np.array([-60.0, -80.0, 0.0, 0.0]), []
    for _ in range(400):
        rows.append(state[:2])
        state = step @ state
    x = np.array(rows) + 0.3 * np.random.default_rng(1).standard_normal((400, 2))
    (folder / "carts.csv").write_text("t,x1,x2\n" + quirks.table(np.arange(400) / 30, *x.T))
    told = fitted("carts.csv", "--mass", "0.4,1", "--edges", "1-anchor,1-2,2-anchor")
    found = {spring["edge"]: spring for spring in told["springs"]}
    for edge, ks, kd in (("1-anchor", left, damping), ("1-2", middle, 0.0), ("2-anchor", right, damping)):
        assert abs(found[edge]["ks"] - ks) < 4 * found[edge]["ks_stderr"]
        assert found[edge]["kd"] == 0 or abs(found[edge]["kd"] - kd) < 4 * found[edge]["kd_stderr"]
        assert found[edge]["ks_stderr"] < 0.02 * ks + 0.05
    assert told["rms"] < 0.32


@pytest.mark.parametrize(("name", "unit"), [("Force (N)", "N"), ("U (V)", "V")])
def test_what_a_sensor_says_of_the_motion_is_fitted_in_its_own_unit(folder, name, unit):
    (folder / "f.csv").write_text(f"Time (s),{name}\n" + quirks.table(quirks.T, quirks.swing()))
    measured = selected("f.csv")
    assert (measured.names, measured.unit) == ([name], unit)
    assert any(
        "fitted as if it were a position" in note and f"amplitudes are in {unit}" in note for note in measured.notes
    )
    told = fitted("f.csv", "--mass", 0.25)
    assert abs(told["springs"][0]["ks"] / quirks.KS - 1) < 0.005
    assert abs(told["springs"][0]["kd"] / quirks.KD - 1) < 0.05
    assert (told["unit"], told["warnings"]) == (unit, [])


def test_few_samples_a_period_and_a_gap_are_no_release_and_no_second_motion(folder):
    t = np.arange(430) / 9.0
    seen = (t < 16) | (t > 24)
    (folder / "g.csv").write_text("t (s),x (m)\n" + quirks.table(t[seen], quirks.swing(t, phase=0.1, noise=2e-3)[seen]))
    assert fitted("g.csv", "--mass", 0.25)["warnings"] == []


@pytest.mark.parametrize(
    ("header", "names"),
    [("t,x (m),y (m),z (m)", ["x (m)"]), ("t,x_A (m),x_B (m),y_A (m)", ["x_A (m)", "x_B (m)"])],
)
def test_an_axis_along_which_nothing_moves_is_left_out(folder, header, names):
    still = np.full(250, 0.1)
    second = quirks.swing(seed=1) if len(names) == 2 else still
    (folder / "s.csv").write_text(header + "\n" + quirks.table(quirks.T, quirks.swing(), second, still))
    measured = selected("s.csv")
    assert measured.names == names
    assert "nothing moves" in dict(measured.left_out)[header.split(",")[-1]]
    assert measured.positions.shape == (250, len(names), 1)
