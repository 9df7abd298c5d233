"""What sensors do: a zero that drifts, channels that are late, a support that moves; truths by scipy to 1e-10."""

import json

import numpy as np
import pytest
from commands import quirks
from scipy.integrate import solve_ivp

from jeuler.__main__ import main

NOISE = 2e-4
T = quirks.T


@pytest.fixture
def fitted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(names, columns, *arguments):
        noise = NOISE * np.random.default_rng(3).standard_normal((len(columns), len(columns[0])))
        clean = [
            column + noise[k] * (name[:1] != "s") for k, (name, column) in enumerate(zip(names, columns, strict=True))
        ]
        (tmp_path / "a.csv").write_text(",".join(["t (s)", *names]) + "\n" + quirks.table(T, *clean))
        assert main(["fit", "a.csv", *arguments, "--json", "out.json"]) == 0
        return json.loads((tmp_path / "out.json").read_text()), capsys.readouterr().out

    return run


def solved(field, start, times):
    return solve_ivp(field, (times[0], times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12).y


def near(told, ks=quirks.KS, kd=quirks.KD):
    for k, spring in enumerate(told["springs"]):
        assert abs(spring["ks"] / np.ravel(ks)[min(k, np.size(ks) - 1)] - 1) < 0.005
        off = abs(spring["kd"] - np.ravel(kd)[min(k, np.size(kd) - 1)])
        assert off < max(0.05 * np.min(kd), 2.5 * spring["kd_stderr"])


@pytest.mark.parametrize(("degree", "moves"), [(1, 0.03), (3, 0.3)])
def test_a_drifting_zero(fitted, degree, moves):
    z = 2 * T / T[-1] - 1
    drift = {1: moves * z / 2, 3: moves * (z / 4 + z**2 / 3 + z**3 / 4)}[degree]
    told, out = fitted(["x (m)"], [quirks.swing(noise=0) + drift], "--mass", "0.25", "--drift", str(degree))
    near(told)
    assert told["warnings"] == []
    found = np.ravel(told["drift"])
    assert len(found) == degree
    np.testing.assert_allclose(found, {1: [moves / 2], 3: moves * np.array([1 / 4, 1 / 3, 1 / 4])}[degree], atol=2e-4)
    assert "drift of x (m)" in out


@pytest.mark.parametrize(("moves", "off"), [(0.02, 0.005), (0.5, 0.03)])
def test_a_drift_that_is_not_fitted_is_warned_of(fitted, moves, off):
    told, _ = fitted(["x (m)"], [quirks.swing(noise=0) + moves * T / 10], "--mass", "0.25")
    (warning,) = told["warnings"]
    assert "The zero drifts by" in warning
    assert "use --drift" in warning
    assert abs(told["springs"][0]["ks"] / quirks.KS - 1) < off


def two_carts(late=0.0):
    """Two carts between three springs, the second seen `late` after the first; each from its own rest."""
    ks, kd, mass = (5.0, 8.0, 6.0), 0.02, (0.4, 0.6)

    def field(t, y):
        x, v = y[:2], y[2:]
        stretch, rate = (x[0], x[1] - x[0], x[1]), (v[0], v[1] - v[0], v[1])
        f = [k * s + kd * r for k, s, r in zip(ks, stretch, rate, strict=True)]
        return [*v, (f[1] - f[0]) / mass[0], (-f[1] - f[2]) / mass[1]]

    fine = np.concatenate([[-1.0], np.unique(np.concatenate([T, T - late])[np.concatenate([T, T - late]) > -1.0])])
    x = solved(field, [0.03, -0.01, 0.0, 0.1], fine)
    return np.interp(T, fine, x[0]), np.interp(T - late, fine, x[1]), ks, kd


@pytest.mark.parametrize("delay", ["fit", "0,?", "0,0.13"])
def test_a_channel_that_is_late(fitted, delay):
    first, second, ks, kd = two_carts(0.13)
    edges = ["--edges", "1-anchor,1-2,2-anchor"]
    told, out = fitted(["x1 (m)", "x2 (m)"], [first, second], "--mass", "0.4,0.6", *edges, "--delay", delay)
    near(told, np.take(ks, (0, 2, 1)), kd)
    assert told["delay"][0] == 0
    assert abs(told["delay"][1] - 0.13) < 2e-3
    assert (told["delay_stderr"][1] is None) == (delay == "0,0.13")
    assert ("delay of particle 2" in out) == (delay != "0,0.13")


def support(t):
    """Its position and velocity."""
    return (
        0.01 * np.sin(5.3 * t) + 0.008 * np.sin(7.9 * t + 1) + 0.1,
        0.053 * np.cos(5.3 * t) + 0.0632 * np.cos(7.9 * t + 1),
    )


@pytest.mark.parametrize("late", [0.0, 0.06])
def test_a_support_that_moves(fitted, late):
    def field(t, y):
        s, rate = support(t - late)
        return y[1], -(quirks.KS * (y[0] - s) + quirks.KD * (y[1] - rate)) / quirks.MASS

    x = solved(field, [0.12, 0.0], T)[0] + 0.25
    arguments = ["--mass", "0.25", "--support", "s"] + (["--delay", "fit"] if late else [])
    told, out = fitted(["x (m)", "s (m)"], [x, support(T)[0]], *arguments)
    near(told)
    assert told["columns"] == ["x (m)"]
    if late:
        assert abs(told["delay"][0] - late) < 1e-3
    assert told["warnings"] == []
    assert "measured position s(t) of the support" in out
    assert "(x - 0.25 - s(t" in told["equation"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--delay", "fit"], "--delay: a particle on a spring of its own may start at any phase"),
        (["--delay", "0", "--edges", "1-anchor"], "may start at any phase"),
        (["--drift", "0"], "--drift must be a degree from 1 to 6, got 0"),
        (["--support", "z"], "--support 'z' is no column; the columns are x, v"),
        (["--support", "v"], "--support v: is of velocity, expected a position"),
        (["--support", "x", "--input", "v"], "--input and --support cannot both be given"),
        (["--input", "v", "--delay", "1,2"], "--delay must be fit, or 1 numbers of s"),
        (["--input", "v", "--delay", "soon"], "--delay must be numbers separated by commas, got 'soon'"),
    ],
)
def test_what_has_no_meaning_is_refused(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    x = quirks.swing()
    (tmp_path / "a.csv").write_text("t,x,v\n" + quirks.table(T, x, np.gradient(x, 0.04)))
    assert main(["fit", "a.csv", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_an_option_for_files_needs_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["fit", "--columns", "x"]) == 2
    assert "--columns has no meaning without a FILE" in capsys.readouterr().err
