"""The models of the command line against data that another solver made."""

import json

import numpy as np
import pytest
from commands import quirks
from scipy.integrate import solve_ivp

from jeuler.__main__ import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def solved(acceleration, start, times):
    """x(t) of x'' = acceleration(x, v) to 1e-9."""
    run = solve_ivp(lambda t, y: (y[1], acceleration(*y)), (0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-12)
    return run.y[0]


def write(name, header, *columns):
    with open(name, "w") as file:
        file.write(header + "\n" + quirks.table(*columns))


def fitted(*arguments):
    assert main(["fit", *map(str, arguments), "--json", "out.json"]) == 0
    with open("out.json") as file:
        return json.load(file)


def noise(times, size=2e-4, seed=0):
    return size * np.random.default_rng(seed).standard_normal(len(times))


def test_dry_friction_is_told_from_viscous(folder, capsys):
    times = np.arange(0, 12, 0.03)
    x = solved(lambda x, v: (-20 * x - 0.01 * np.tanh(v / 1e-3)) / 0.25, (0.05, 0.0), times)
    write("dry.csv", "t,x", times, 0.3 + x + noise(times))
    told = fitted("dry.csv", "--mass", 0.25, "--friction", "compare")
    assert told["friction"] == ["dry"]
    np.testing.assert_allclose(told["dry_friction"], 0.01, rtol=0.02)
    np.testing.assert_allclose(told["springs"][0]["ks"], 20, rtol=0.002)
    scores = {row["friction"]: row["score"] for row in told["comparison"]}
    assert scores["dry"] == 0
    assert scores["viscous"] > 100
    rms = {tuple(row["friction"].split("+")): row["rms"] for row in told["comparison"]}
    assert len(rms) == 6
    for law in rms:  # one of two parts begins where the better of these ended
        assert rms[law] <= min(rms[part,] for part in law) * (1 + 1e-9)
    assert "friction viscous " in capsys.readouterr().out
    wrong = fitted("dry.csv", "--mass", 0.25)
    assert any("Try --friction compare" in warning for warning in wrong["warnings"])


def test_pendulum_at_large_angles(folder):
    times = np.arange(0, 10, 0.02)
    angle = solved(lambda x, v: -64.0 * np.sin(x) - 0.06 * v, (1.6, 0.0), times)
    write("swing.csv", "t (s),theta (rad)", times, angle + noise(times, 1e-3))
    told = fitted("swing.csv", "--mass", 1, "--pendulum")
    np.testing.assert_allclose(told["modes"][0]["natural_frequency"] ** 2, 64.0, rtol=1e-3)
    np.testing.assert_allclose(told["springs"][0]["kd"], 0.06, rtol=0.02)
    np.testing.assert_allclose(told["pendulum_length"], 9.80665 / 64, rtol=1e-3)
    assert told["warnings"] == []
    wrong = fitted("swing.csv", "--mass", 1)
    assert any("a pendulum is no linear spring there; use --pendulum" in warning for warning in wrong["warnings"])


def test_several_masses_on_one_spring(folder):
    """Shared ks and kd, and the spring's own effective mass of 20 g."""
    names = []
    for k, mass in enumerate((0.19, 0.253, 0.4)):
        heavy = mass + 0.02
        decay = 0.05 / 2 / heavy
        omega = np.sqrt(20 / heavy - decay**2)
        times = np.arange(200 + 20 * k) * 0.04
        x = 0.1 * k + 0.05 * np.exp(-decay * times) * np.cos(omega * times + k) + noise(times, seed=k)
        names.append(f"mass{k}.csv")
        write(names[-1], "t (s),x (m)", times + k, x)
    told = fitted(*names, "--mass", "0.19,0.253,0.4")
    assert len(told["springs"]) == 1
    np.testing.assert_allclose(told["springs"][0]["ks"], 20, rtol=0.005)
    np.testing.assert_allclose(told["springs"][0]["kd"], 0.05, rtol=0.05)
    np.testing.assert_allclose(told["spring_mass"], 0.02, rtol=0.05)


def test_an_unknown_mass_beside_a_known_one(folder):
    from scipy.linalg import expm

    mass, stiffness = np.array([[0.3], [0.5]]), np.array([[10.0 + 6.0, -6.0], [-6.0, 6.0 + 8.0]])
    system = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness / mass, -0.05 * np.eye(2) / mass]])
    times = np.arange(300) / 30
    x = np.array([(expm(system * t) @ [0.05, -0.02, 0.0, 0.1])[:2] for t in times])
    write("two.csv", "t,x1,x2", times, *(x + noise(times, 1e-4)[:, None]).T)
    told = fitted("two.csv", "--mass", "0.3,?", "--edges", "1-anchor,1-2,2-anchor")
    np.testing.assert_allclose(told["mass"], [0.3, 0.5], rtol=0.02)
    np.testing.assert_allclose([s["ks"] for s in told["springs"]], [10, 8, 6], rtol=0.02)  # anchors first


def test_a_measured_force_on_a_hardening_spring(folder, capsys):
    times = np.arange(900) / 100
    sines = [(3.0, 0.2), (5.5, 1.1), (8.0, 2.9), (13.0, 0.7)]

    def force(t):
        return sum(np.sin(omega * t + phase) for omega, phase in sines)

    run = solve_ivp(
        lambda t, y: (y[1], (-20 * y[0] - 90 * y[0] ** 3 - 0.3 * y[1] + 0.7 * force(t)) / 0.25),
        (0, 9),
        (0.0, 0.0),
        t_eval=times,
        rtol=1e-9,
        atol=1e-12,
    )
    write("forced.csv", "t (s),u (V),x (m)", times, force(times), run.y[0] + noise(times))
    told = fitted("forced.csv", "--mass", 0.25, "--input", "u", "--cubic")
    np.testing.assert_allclose(told["springs"][0]["ks"], 20, rtol=0.01)
    np.testing.assert_allclose(told["springs"][0]["kd"], 0.3, rtol=0.01)
    np.testing.assert_allclose(told["cubic"], 90, rtol=0.03)
    np.testing.assert_allclose(told["gain"], 0.7, rtol=0.01)
    assert "u is the measured force u(t)." in told["notes"]
    assert main(["fit", "forced.csv", "--input", "v"]) == 2
    assert "--input 'v' is no column" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("x", "words"),
    [
        (
            lambda t: np.where(t < 1.0, 0.35, quirks.swing(np.maximum(t - 1, 0), phase=0.0, noise=0)),
            "the release is in the record",
        ),
        (lambda t: quirks.swing(t) + 0.02 * np.cos(15 * t), "another oscillation, at 2.3"),
        (lambda t: np.random.default_rng(3).standard_normal(len(t)), "its numbers mean nothing"),
        (lambda t: quirks.swing(t / 12), "periods: ks and kd lean on the model"),
    ],
)
def test_a_wrong_model_is_said(folder, x, words):
    write("x.csv", "t,x", quirks.T, x(quirks.T))
    warnings = fitted("x.csv")["warnings"]
    assert any(words in warning for warning in warnings), warnings
    assert any("No --mass was given" in warning for warning in warnings)


def test_all_masses_unknown_is_refused(folder, capsys):
    write("x.csv", "t,x", quirks.T, quirks.swing())
    assert main(["fit", "x.csv", "--mass", "fit"]) == 2
    assert "determines masses and stiffnesses only as their ratio" in capsys.readouterr().err
