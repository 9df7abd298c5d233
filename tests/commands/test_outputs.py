"""What the command writes and where; what it refuses; what `look` says."""

import json
import os
import threading

import numpy as np
import pytest
from commands import quirks

from jeuler.__main__ import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t = quirks.T[:60]
    (tmp_path / "good.csv").write_text("t,x\n" + quirks.table(t, quirks.swing(t)))
    return tmp_path


def run(capsys, *arguments):
    try:
        code = main([*map(str, arguments)])
    except SystemExit as stop:
        code = stop.code
    told = capsys.readouterr()
    return code, told.out, told.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--json", "good.csv"], "--json good.csv: is the measured file itself"),
        (["--json", "link.csv"], "--json link.csv: is the measured file itself"),
        (["--plot", "same.png", "--json", "same.png"], "must be different files"),
        (["--report", "good.csv"], "--report good.csv: is the measured file itself"),
        (["--report", "same.html", "--json", "same.html"], "--json and --report must be different files"),
        (["--report", "-", "--json", "-"], "one output at most can be -"),
        (["--report", "nodir/a.html"], "--report nodir/a.html: there is no folder"),
        (["--plot", "nodir/a.png"], "--plot nodir/a.png: there is no folder"),
        (["--json", "nodir/a.json"], "--json nodir/a.json: there is no folder"),
        (["--plot", "adir"], "--plot adir: is a folder"),
        (["--plot", "a.exe"], "must end in .png"),
        (["--plot", ""], "--plot must have a value, got none"),
        (["--dt", "0"], "--dt must be a positive finite number, got 0"),
        (["--dt", "1e-300"], "--dt 1e-300: .* steps"),
        (["--dt", "100"], "--dt 100: must be below a tenth of the period"),
        (["--dt", "nan"], "--dt must be a positive finite number, got nan"),
        (["--from", "nan"], "--from must be a finite number, got nan"),
        (["--edges", ""], "--edges must have a value, got none"),
        (["--edges", "1-anchor,1-anchor"], "names the spring '1-anchor' twice"),
        (["--mass", "1e300"], "--mass must be one positive number"),
        (["--columns", ""], "--columns must have a value, got none"),
        (["--columns", "x,x"], "--columns names 'x' more than once"),
        (["--columns", "t"], "no column 't', the columns are x"),
        (["--run", "2"], "no run '2', there are 1"),
        (["--unit", "x=furlong"], "the unit 'furlong' of 'x' is not known"),
        (["--unit", "mm"], "--unit must be like x=mm,t=ms"),
        (["--time", "clock"], "no column 'clock' for the time"),
        (["--observe", "angle"], "--observe angle: no column is one"),
        (["--friction", "sticky"], "--friction must be viscous, quadratic or dry"),
        (["--max-iterations", "0"], "--max-iterations must be 1 or more"),
        (["good.csv"], "each recording must be given once"),
        (["--pendulum", "--edges", "1-anchor"], "--edges has no meaning with --pendulum"),
        (["--skip", "70"], "no data"),
        (["--foo"], "unrecognized arguments"),
    ],
)
def test_refused_before_the_fit_in_one_line(folder, capsys, arguments, message):
    import re

    (folder / "adir").mkdir()
    (folder / "link.csv").symlink_to("good.csv")
    before = (folder / "good.csv").read_text()
    code, out, error = run(capsys, "fit", "good.csv", *arguments)
    assert (code, out) == (2, "")
    assert error.count("\n") == 1
    assert re.search(message, error), error
    assert (folder / "good.csv").read_text() == before
    assert not list(folder.glob("*.png"))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.full(60, 0.3), "x.csv: nothing moves"),
        (
            quirks.swing(quirks.T[:5]),
            "x.csv: 5 values cannot determine 5 unknowns (ks, kd, position, velocity, offset)",
        ),
        (quirks.swing(quirks.T[:4]), "x.csv: 4 rows, expected 5"),
    ],
)
def test_data_that_determine_nothing(folder, capsys, values, message):
    (folder / "x.csv").write_text("t,x\n" + quirks.table(quirks.T[: len(values)], values))
    code, _, error = run(capsys, "fit", "x.csv")
    assert code == 2
    assert message in error


def test_json_to_standard_output_link_and_pipe(folder, capsys):
    (folder / "target.json").write_text("old")
    (folder / "link.json").symlink_to("target.json")
    os.mkfifo(folder / "pipe")
    got = []
    reader = threading.Thread(target=lambda: got.append((folder / "pipe").read_text()))
    reader.start()
    code, out, error = run(capsys, "fit", "good.csv", "--mass", 0.25, "--json", "-")
    told = json.loads(out)
    assert code == 0
    assert "natural frequency" in error
    assert told["springs"][0]["edge"] == "1-anchor"
    assert run(capsys, "fit", "good.csv", "--mass", 0.25, "--json", "link.json")[0] == 0
    assert (folder / "link.json").is_symlink()
    assert json.loads((folder / "target.json").read_text())["springs"] == told["springs"]
    assert (
        run(capsys, "fit", "good.csv", "--mass", 0.25, "--json", "pipe", "--plot", "fit.svg", "--report", "fit.html")[0]
        == 0
    )
    reader.join(20)
    assert json.loads(got[0])["springs"] == told["springs"]
    assert (folder / "fit.svg").read_text().lstrip().startswith("<?xml")
    page = (folder / "fit.html").read_text()
    assert f"{told['springs'][0]['ks']:.6g}" in page
    assert f"{told['springs'][0]['ks'] - 1.96 * told['springs'][0]['ks_stderr']:.6g} to " in page
    assert "natural frequency" in page
    code, out, error = run(capsys, "fit", "good.csv", "--mass", 0.25, "--report", "-")
    assert (code, out.count("<!doctype html>")) == (0, 1)
    assert "natural frequency" in error


def test_what_is_left_out_has_its_whole_reason(folder, capsys):
    t = quirks.T[:60]
    long = "x" * 200
    rows = np.stack([t, quirks.swing(t), np.abs(quirks.swing(t))], 1)
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (folder / "more.csv").write_text("\n".join(["t (s),x (m)," + f"Absolute {long} (m)", *lines]))
    _, out, _ = run(capsys, "fit", "more.csv", "--mass", 0.25, "--json", "told.json")
    (entry,) = json.loads((folder / "told.json").read_text())["left_out"]
    assert len(entry["reason"]) > 20
    assert f"({entry['reason']})" in out
    assert long not in out


def test_names_that_a_picture_or_a_terminal_would_take_amiss(folder, capsys):
    text = (folder / "good.csv").read_text()
    (folder / "odd.csv").write_text(text.replace("t,x", "t,x$\\frac{$\x1b[31mred", 1))
    code, out, _ = run(capsys, "fit", "odd.csv")
    assert code == 0
    assert "\x1b" not in out
    assert (folder / "jeuler_fit.png").exists()


def test_look(folder, capsys):
    quirks.write(folder)
    code, out, _ = run(capsys, "look", "pasco.csv")
    assert code == 0
    for words in (
        "pasco.csv: 3 runs",
        "run 2: 250 rows, 0 to 9.96 s, 25 samples a second",
        "velocity, ",
        "left out: velocity; position is fitted",
        "oscillates at 1.42",
        "fit pasco.csv --run 2 --mass KG",
    ):
        assert words in out, words
    assert out.count("*") > 60  # the small picture
    _, out, _ = run(capsys, "look", "millimetres.csv")
    assert "position along x, 0.25" in out
    assert "m (from mm)" in out
    code, _, error = run(capsys, "look", "absent.csv")
    assert code == 2
    assert error.startswith("jeuler look: error: ")


def test_the_command_that_look_suggests_runs(folder, capsys):
    quirks.write(folder)
    import shlex

    _, out, _ = run(capsys, "look", "clocks.txt")
    words = shlex.split(out.strip().splitlines()[-1])
    assert words[:4] == ["python", "-m", "jeuler", "fit"]
    assert run(capsys, *[word.replace("KG", "0.25") for word in words[3:]])[0] == 0
