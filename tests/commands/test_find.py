"""``python -m jeuler find``: springs from a file of tracks, its outputs, and what it refuses."""

import json

import numpy as np
import pytest

from jeuler.__main__ import main

T = np.linspace(0.0, 6.0, 121)
SLOW, FAST = 0.3 * np.cos(2.0 * T), 0.2 * np.cos(np.sqrt(12.0) * T)  # two masses of 1 kg between walls, ks = 4, 4, 4
COLUMNS = {"x1 (m)": 0 * T, "x2 (m)": 1 + SLOW + FAST, "x3 (m)": 2 + SLOW - FAST, "x4 (m)": 0 * T + 3}


@pytest.fixture
def tracks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [",".join(["t (s)", *COLUMNS]), *(",".join(f"{x:.7f}" for x in row) for row in zip(T, *COLUMNS.values()))]  # noqa: B905
    (tmp_path / "tracks.csv").write_text("\n".join(rows))
    return tmp_path


def test_springs_are_found_printed_drawn_and_written(tracks, capsys):
    assert (
        main(["find", "tracks.csv", "--mass", "inf,1,1,inf", "--dim", "1", "--plot", "net.svg", "--json", "net.json"])
        == 0
    )
    printed = capsys.readouterr().out
    assert "tracks.csv: 3 springs between 4 particles" in printed
    found = json.loads((tracks / "net.json").read_text())
    assert [spring["particles"] for spring in found["springs"]] == [[1, 2], [2, 3], [3, 4]]
    np.testing.assert_allclose([spring["ks"] for spring in found["springs"]], 4.0, rtol=1e-3)
    assert found["explained"] is True
    assert found["mass"] == [None, 1.0, 1.0, None]
    assert "<svg" in (tracks / "net.svg").read_text()
    for line in found["message"].split("; "):
        assert line in printed


WRONG = {
    "": "the following arguments are required: FILE",
    "missing.csv": "missing.csv",
    "tracks.csv --dim 1 --mass 1,2": "--mass must be one positive number of kg or 4, one a particle (inf for one that is pinned)",
    "tracks.csv --dim 1 --mass 0": "--mass must be one positive number",
    "tracks.csv --dim 1 --gravity 0,1": "--gravity must be 1 finite numbers, one a coordinate",
    "tracks.csv --dim 1 --sigma=-1": "--sigma",
    "tracks.csv --dim 4": "between the positions of two particles or more, got 1 of position",
    "tracks.csv --plot tracks.csv": "is the measured file itself",
    "tracks.csv --plot net.doc": "a picture's name must end in",
    "tracks.csv --input x1": "unrecognized arguments",
    "tracks.csv --dim 1 --run 7": "no run '7'",
}  # fmt: skip


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_command_is_told_in_one_line(tracks, capsys, line):
    try:
        code = main(["find", *line.split()])
    except SystemExit as end:
        code = end.code
    error = capsys.readouterr().err
    assert code == 2
    assert error.count("\n") == 1
    assert WRONG[line] in error
