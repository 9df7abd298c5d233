"""The command line: the main job, what it prints and writes, and one line for bad input."""

import json
import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.__main__ import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG")


def number(text, name):
    return float(re.search(rf"{name}\s+(-?[\d.e+-]+)", text).group(1))


def test_built_in_example(folder, capsys):
    assert main(["fit", "--json", "out.json"]) == 0
    text = capsys.readouterr().out
    assert abs(number(text, "ks") - 20) < 0.1
    assert abs(number(text, "kd") - 0.3) < 0.01
    for unit in ("N/m", "N s/m", "rad/s", "Hz", "% of the amplitude", "s in all"):
        assert unit in text
    assert is_png(folder / "jeuler_fit.png")
    report = json.loads((folder / "out.json").read_text())
    mode = report["modes"][0]
    np.testing.assert_allclose(mode["natural_frequency"], np.sqrt(report["springs"][0]["ks"] / 0.5), rtol=1e-9)
    np.testing.assert_allclose(
        mode["damping_ratio"], report["springs"][0]["kd"] / (2 * 0.5 * mode["natural_frequency"]), rtol=1e-9
    )
    assert 0.0005 < report["rms"] < 0.002
    assert sorted(path.name for path in folder.iterdir()) == ["jeuler_fit.png", "out.json"]


@pytest.mark.parametrize(
    ("drag", "squared", "tolerance", "rms"), [(None, 22.9, 0.3, 2.1e-3), ("quadratic", 22.6, 0.2, 1.3e-3)]
)
def test_sphere_in_water(sphere_in_water, folder, drag, squared, tolerance, rms):
    arguments = ["fit", str(sphere_in_water), "--from", "0.75", "--json", "out.json"]
    assert main(arguments + (["--drag", drag] if drag else [])) == 0
    report = json.loads((folder / "out.json").read_text())
    assert report["samples"] == 723
    assert abs(report["modes"][0]["natural_frequency"] ** 2 - squared) <= tolerance
    assert report["rms"] <= rms
    t, x = np.genfromtxt(sphere_in_water, delimiter=",", comments="#").T
    x = x[t >= 0.75]
    np.testing.assert_allclose(report["amplitude"], np.max(np.abs(x - x.mean())), rtol=1e-6)
    np.testing.assert_allclose(report["share_of_amplitude"], report["rms"] / report["amplitude"])


def test_two_coupled_particles(folder, capsys):
    """Two masses in the plane, one on an anchor, one hanging on the first: columns x1 y1 x2 y2."""
    ks, kd = (30.0, 12.0), (0.4, 0.2)
    scene = jeuler.Scene(
        forces=(jeuler.Springs([[0, 2]], ks[0], kd[0], 0.0), jeuler.Springs([[0, 1]], ks[1], kd[1], 0.5))
    )
    state = jeuler.ParticleState([[0.05, 0.02], [0.6, 0.1], [0.0, 0.0]], jnp.zeros((3, 2)), mass=[0.2, 0.3, jnp.inf])
    run = jeuler.simulate(scene, state, dt=1e-3, num_steps=3000, step=jeuler.rk4_step, save_every=25)
    table = np.column_stack([run.t, *np.asarray(run.y.position[:, :2]).reshape(len(run.t), 4).T])
    np.savetxt("two.tsv", table, delimiter="\t", header="t\tx1\ty1\tx2\ty2", comments="")
    assert (
        main(["fit", "two.tsv", "--mass", "0.2,0.3", "--edges", "1-anchor,1-2", "--json", "o.json", "--plot", "o.png"])
        == 0
    )
    springs = json.loads((folder / "o.json").read_text())["springs"]
    assert [spring["edge"] for spring in springs] == ["1-anchor", "1-2"]
    np.testing.assert_allclose([spring["ks"] for spring in springs], ks, rtol=0.01)
    np.testing.assert_allclose([spring["kd"] for spring in springs], kd, rtol=0.05)
    assert is_png(folder / "o.png")
    assert capsys.readouterr().out.count("natural frequency") >= 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "absent.csv"], "No such file"),
        (["fit", "bad.csv"], r"bad.csv: line 3: column 2 \(x\): expected a number, got 'high'"),
        (["fit", "good.csv", "--mass", "-1"], "--mass must be one positive number of kg or 1"),
        (["fit", "good.csv", "--mass", "1,2,3"], "--mass must be one positive number of kg or 1"),
        (["fit", "good.csv", "--mass", "heavy"], "--mass must be numbers separated by commas, got 'heavy'"),
        (
            ["fit", "good.csv", "--edges", "1-2"],
            "--edges must be like 1-2,2-anchor with particles from 1 to 1, got '1-2'",
        ),
        (["fit", "good.csv", "--start", "ks=-4"], "--start must be like ks=20,kd=0.3"),
        (["fit", "good.csv", "--from", "100"], "0 rows between --from and --to.* the times run from 0 to"),
        (["fit", "good.csv", "--columns", "y"], "no column 'y', the columns are x"),
        (["fit", "good.csv", "--dim", "2"], "do not make particles of 2 coordinates"),
        (["fit", "good.csv", "--dt", "-1"], "--dt must be a positive finite number, got -1"),
        (["fit", "good.csv", "--drag", "cubic"], "invalid choice"),
        (["fit", "good.csv", "--dt", "fast"], "argument --dt: invalid float value: 'fast'"),
        (["fly"], "invalid choice"),
        ([], "required"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, message):
    (folder / "bad.csv").write_text("t,x\n0,1\n1,high\n")
    t = np.linspace(0, 3, 40)
    np.savetxt("good.csv", np.column_stack([t, np.cos(4 * t)]), delimiter=",", header="t,x", comments="")
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error), error
    assert not list(folder.glob("*.png"))


def test_module_runs_as_a_program(folder):
    done = subprocess.run([sys.executable, "-m", "jeuler", "--help"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert "fit" in done.stdout
    done = subprocess.run(
        [sys.executable, "-m", "jeuler", "fit", "none.csv"], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr
