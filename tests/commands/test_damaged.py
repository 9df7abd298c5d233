"""Damaged files: right, or one line that names the file and the place; an earlier result survives."""

import re

import pytest
from commands import damaged, quirks

from jeuler.__main__ import main, parser
from jeuler.commands.selection import recordings_in, select


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_two_hundred_are_read_right_or_refused_with_their_place(folder):
    good = dict(zip(quirks.T.round(6).tolist(), quirks.swing().round(6).tolist(), strict=True))
    told = parser().parse_args(["fit", "d.csv"])
    read = 0
    for kind, raw in damaged.files(200):
        (folder / "d.csv").write_bytes(raw)
        try:
            measured = select(recordings_in("d.csv", told), told)
        except ValueError as refusal:
            message = str(refusal)
            assert re.search(r"d\.csv: (line \d+|no data|not a text file|\d rows)", message), (kind, message)
            assert "\n" not in message, kind
            assert len(message) < 500, kind
            continue
        read += 1
        assert measured.positions.shape[1:] == (1, 1), kind
        values = measured.positions[:, 0, 0].tolist()
        wrong = [t for t, x in zip(measured.times.tolist(), values, strict=True) if x == x and good.get(t) != x]
        assert len(wrong) <= 1, kind  # a last line cut inside a number, a digit changed: the fit warns of such a row
    assert read > 30


def test_an_earlier_result_survives_and_the_refusal_is_one_line(folder, capsys):
    (folder / "out.json").write_text("old")
    (folder / "jeuler_fit.png").write_text("old")
    for kind, raw in damaged.files(14):
        (folder / "d.csv").write_bytes(raw)
        if kind in ("truncated", "lines lost", "header lost", "a byte changed", "quotes"):
            continue
        assert main(["fit", "d.csv", "--json", "out.json"]) == 2, kind
        error = capsys.readouterr().err
        assert error.count("\n") == 1, kind
        assert error.startswith("jeuler fit: error: d.csv: line "), kind
    assert (folder / "out.json").read_text() == "old"
    assert (folder / "jeuler_fit.png").read_text() == "old"


def test_a_damaged_value_is_warned_of(folder, capsys):
    lines = damaged.GOOD.splitlines()
    lines[-1] = lines[-1][:11]  # cut inside a number
    (folder / "d.csv").write_text("\n".join(lines))
    assert main(["fit", "d.csv", "--mass", "0.25"]) == 0
    assert "1 row far from the model, the first at 9.96 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n".join(",".join([str(row)] + ["1.5"] * 5_000) for row in range(6)), "line 1: 5001 columns, at most 5000"),
        (
            "\n".join(",".join(["t" if row < 0 else str(row)] + ["1.5"] * 400) for row in range(6)),
            "400 columns are of position, at most 30 are fitted without --columns",
        ),
        ("t,x\n" + "".join(f"{k},{1e300 * (-1) ** k}\n" for k in range(20)), "line 2: column 2 (x): 1e+300 is larger"),
        ("t,x\n" + "".join(f"{k * 1e-300},{k % 3}\n" for k in range(20)), "column 1 (t): the times span 1.9e-299 s"),
        ("t,x\n" + "".join(f"7,{k % 3}\n" for k in range(20)), "column 1 (t): the times span 0 s"),
        ("t,x\n" + "".join(f"{k},{k % 3 * 1e-200}\n" for k in range(20)), "column 2 (x): moves by 2e-200 m"),
    ],
)
def test_numbers_and_widths_of_no_measurement(folder, capsys, text, message):
    (folder / "d.csv").write_text(text)
    assert main(["fit", "d.csv"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jeuler fit: error: d.csv: " + message)
    assert error.count("\n") == 1
