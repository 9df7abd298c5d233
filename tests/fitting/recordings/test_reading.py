"""Recordings as they come: every layout gives the same numbers, every fault one line that names its place."""

import gzip
import importlib
import io
import sys
import zipfile
from contextlib import contextmanager

import numpy as np
import pytest

import jeuler
from jeuler.fitting.recordings.reading import read_table
from jeuler.fitting.recordings.recording import understand

T = np.arange(0, 10) * 0.04
X = np.round(0.3 + 0.05 * np.cos(9 * T), 5)


def rows(separator=",", point=".", ends="\n", form="{:.5f}"):
    return (
        ends.join(separator.join(form.format(v).replace(".", point) for v in pair) for pair in zip(T, X, strict=True))
        + ends
    )


LAYOUTS = {
    "names by blanks above tabs": "t       x\r\n" + rows("\t", ends="\r\n"),
    "a title above the names": "mass_A\nt\tx\t\n" + rows("\t"),
    "a title with a number": "Sample rate,60\nt,x\n" + rows(),
    "titles and a row of units": "Logger 2\nx.cmbl 3/12/2024 17:31:44 .\nData Set\nTime\tx\nt\tx\ns\tm\n\n"
    + rows("\t"),
    "percent header": "% t x\n" + rows("  "),
    "names in a comment": "#Creator: logger 2\n#t\tx\n#[s]\t[m]\n" + rows("\t"),
    "comment of names among prose": "# a metal ball, swinging\n# columns: t,x\n# units: t s, x m\n" + rows(),
    "semicolons and decimal commas": '\ufeff"t";"x"\n' + rows(";", ","),
    "tabs and decimal commas": "t\tx\n" + rows("\t", ","),
    "separator at the end": "t,x,\n" + rows().replace("\n", ",\n"),
    "only the data end with a separator": "t,x\n" + rows().replace("\n", ",\n"),
    "carriage returns": "t,x\r" + rows(ends="\r"),
    "exponents": "t,x\n" + rows(form="{:.9E}"),
    "quoted cells": '"t","x"\n' + "".join(f'"{a}","{b}"\n' for a, b in zip(T, X, strict=True)),
    "a line break in a name": '"t\n",x\n' + rows(),
    "a title of as many words as names": "My swing\n\nt  x\n" + rows("  "),
    "labels before the numbers": "".join(f"t:{a:.5f},x:{b}\n" for a, b in zip(T, X, strict=True)),
    "a line of JSON a row": "".join(f'{{"t": {a:.5f}, "x": {b}}}\n' for a, b in zip(T, X, strict=True)),
    "stamps of a serial monitor": "16:38:00.001 -> t,x\n"
    + "".join(f"16:38:00.{k:03d} -> {a:.5f},{b}\n" for k, (a, b) in enumerate(zip(T, X, strict=True))),
    "a header that says where it ends": "LabVIEW\t\n***End_of_Header***\t\nX_Dimension\tTime\t\n***End_of_Header***\t\nt\tx\tComment\n"
    + rows("\t"),
    "numbers above the names": "Version,1.2,Rate,25\n,,Marker\n12,34\nt,x\n" + rows(),
    "the time last": "x,t\n" + "".join(f"{b},{a:.5f}\n" for a, b in zip(T, X, strict=True)),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(layout, encoding):
    text = LAYOUTS[layout].removeprefix("\ufeff")
    times, columns = jeuler.read_trajectory(io.BytesIO(text.encode(encoding)))
    np.testing.assert_array_equal(times, np.round(T, 5))
    assert list(columns) == ["x"]
    np.testing.assert_array_equal(columns["x"], X)


@pytest.mark.parametrize("cell", ["", "nan", "NA", "#N/A", "#DIV/0!", "#VALUE!", "null", "-", "--"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_missing_cells(cell, separator):
    text = separator.join("tx") + "\n" + rows(separator).replace(f"{X[3]:.5f}", cell, 1)
    _, columns = jeuler.read_trajectory(io.StringIO(text))
    np.testing.assert_array_equal(np.isnan(columns["x"]), np.arange(10) == 3)


@pytest.mark.parametrize(
    "stamp",
    [
        "2024-05-17 16:38:{:06.3f}",
        "2024-05-17T16:38:{:06.3f}Z",
        "17.05.2024 16:38:{:06.3f}",
        "5/17/2024 4:38:{:06.3f} PM",
        "16:38:{:06.3f}",
        "38:{:06.3f}",
        "17-May-2024 16:38:{:06.3f}",
    ],
)
def test_dates_and_times_of_day(stamp):
    text = "when,x\n" + "".join(f"{stamp.format(a)},{b}\n" for a, b in zip(T, X, strict=True))
    times, columns = jeuler.read_trajectory(io.StringIO(text))
    np.testing.assert_allclose(times, T, atol=1e-9)
    np.testing.assert_array_equal(columns["x"], X)


def test_times_of_day_past_midnight_and_with_a_column_of_dates():
    text = "clock,x\n23:59:58,1\n23:59:59,2\n00:00:00,3\n00:00:01,4\n"
    assert jeuler.read_trajectory(io.StringIO(text)).times.tolist() == [0, 1, 2, 3]
    text = "date,time,x\n2024-02-28,23:59:59,1\n2024-02-29,00:00:00,2\n2024-02-29,00:00:01,3\n"
    times, columns = jeuler.read_trajectory(io.StringIO(text))
    assert times.tolist() == [0, 1, 2]
    assert list(columns) == ["x"]


def test_compressed_and_open_files(tmp_path):
    raw = ("t,x\n" + rows()).encode()
    (tmp_path / "a.csv").write_bytes(raw)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(raw))
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("Raw Data.csv", raw)
        archive.writestr("meta/device.csv", "property,value\n")
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.csv", raw)
        archive.writestr("b.csv", raw)
    for name in ("a.csv", "a.csv.gz", "a.zip"):
        np.testing.assert_array_equal(jeuler.read_trajectory(tmp_path / name).columns["x"], X)
        with open(tmp_path / name, "rb") as file:
            np.testing.assert_array_equal(jeuler.read_trajectory(file).columns["x"], X)
    with pytest.raises(ValueError, match=r"two.zip: expected a zip file with one table in it, got 2: a.csv, b.csv"):
        jeuler.read_trajectory(tmp_path / "two.zip")


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frames(library):
    frames = importlib.import_module(library)
    times, columns = jeuler.read_trajectory(frames.DataFrame({"t": T, "x": X}))
    np.testing.assert_array_equal(times, T)
    np.testing.assert_array_equal(columns["x"], X)
    with pytest.raises(ValueError, match=r"row 2: column 2 \(x\): expected a number, got 'high'"):
        jeuler.read_trajectory(frames.DataFrame({"t": ["0", "1"], "x": ["1", "high"]}))


def test_workbook(tmp_path):
    import pandas

    frame = pandas.DataFrame({"Time (s)": T, "x (m)": X})
    with pandas.ExcelWriter(tmp_path / "a.xlsx") as book:
        frame.to_excel(book, sheet_name="Raw Data", index=False)
        pandas.DataFrame({"property": ["device"]}).to_excel(book, sheet_name="Metadata Device", index=False)
    times, columns = jeuler.read_trajectory(tmp_path / "a.xlsx")
    np.testing.assert_allclose(times, T)
    np.testing.assert_array_equal(columns["x (m)"], X)
    raw = (tmp_path / "a.xlsx").read_bytes()
    (tmp_path / "b.xlsx").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(ValueError, match=r"b.xlsx"):
        jeuler.read_trajectory(tmp_path / "b.xlsx")


def test_matlab_columns(tmp_path):
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"t": T, "x": X, "note": "a ball"})
    times, columns = jeuler.read_trajectory(tmp_path / "a.mat")
    np.testing.assert_array_equal(times, T)
    np.testing.assert_array_equal(columns["x"], X)


def test_si_converts_and_without_it_the_user_is_told():
    text = "Time (ms),x (mm),Accel (g)\n0,350,1\n40,346,0.5\n"
    with pytest.warns(UserWarning, match=r"Time \(ms\), x \(mm\), Accel \(g\).* si=True"):
        times, columns = jeuler.read_trajectory(io.StringIO(text))
    assert times.tolist() == [0, 40]
    assert columns["x (mm)"].tolist() == [350, 346]
    times, columns = jeuler.read_trajectory(io.StringIO(text), si=True)
    np.testing.assert_allclose(times, [0, 0.04])
    np.testing.assert_allclose(columns["x (mm)"], [0.35, 0.346])
    np.testing.assert_allclose(columns["Accel (g)"], [9.80665, 4.903325])


def test_runs_side_by_side():
    text = "Time (s) Run #1;x (m) Run #1;Time (s) Run #2;x (m) Run #2\n0;1;0;4\n1;2;1;5\n;;2;6\n"
    with pytest.warns(UserWarning, match="2 runs; run 2 with the most rows was read, run='1' reads another"):
        times, columns = jeuler.read_trajectory(io.StringIO(text))
    assert times.tolist() == [0, 1, 2]
    assert columns["x (m) Run #2"].tolist() == [4, 5, 6]
    assert jeuler.read_trajectory(io.StringIO(text), run=1).columns["x (m) Run #1"].tolist() == [1, 2]
    with pytest.raises(ValueError, match="no run '3', there are 1, 2"):
        jeuler.read_trajectory(io.StringIO(text), run=3)


def test_runs_stacked():
    text = "t,x\n" + rows() + rows()[: rows().index("\n") * 6 + 6]
    recordings = understand(read_table(io.StringIO(text)))
    assert [len(recording.times) for recording in recordings] == [10, 6]
    assert "The clock starts again at line 12: 2 runs." in recordings[0].notes


@pytest.mark.parametrize("order", [slice(None, None, -1), [0, 1, 2, 4, 3, 5, 6, 7, 8, 9]])
def test_rows_out_of_order_are_refused_with_their_line(order):
    text = "t,x\n" + "".join(f"{a},{b}\n" for a, b in zip(T[order], X[order], strict=True))
    with pytest.raises(ValueError, match=r"line \d+: column 1 \(t\): the time goes back from .* times must increase"):
        understand(read_table(io.StringIO(text)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,high\n1,2\n2,3\n", r"line 2: column 2 \(x\): expected a number, got 'high'"),
        ("0,high\n1,2\n2,3\n", r"line 1: column 2 .*got 'high'"),
        ("t,x\n0," + "1" * 200_000 + "\n1,2\n", r"line 2: column 2 \(x\): .* \(200000 characters\)"),
        ('t,x\n0,"' + "1" * 200_000 + '"\n1,2\n', "line 2: .*131072"),
        ('t,x\n"0,1\n0.1,2\n', "line 2: column 1: a quote that is not closed"),
        ("t,x\n0,1\n1,1_0\n", "line 3: column 2 .*got '1_0'"),
        ("t,x\n0,1\n1,0x10\n", "line 3: column 2 .*got '0x10'"),
        ("t,x\n0,1\n1,1e400\n", "line 3: column 2 .*got '1e400'"),
        ("t,x\n0,1\n1,٦.١\n", "line 3: column 2"),
        ('t;x\n0.0;"1,250"\n0.1;"1,251"\n', "line 2: column 2 .*the comma is ambiguous"),
        ("t,x\n0,000,1,5\n0,100,1,6\n", "line 2: 4 cells, expected 2.*decimal commas cannot be told from separators"),
        ("t,x\n0,1\n1,2\nt,x\n0,1\n", r"line 4: column 1 \(t\): expected a number, got 't'"),
        ("t,x\n2024-01-01 00:00:00,1\n2024-01-01 00:00:01,2\nsoon,3\n", "line 4: column 1 .*expected a date"),
        ("a,b,c\nd,e,f\n", "line 1: only names and no numbers"),
        ("t,x\n0,1\n0.1,2\0\n", "line 3: not a text file"),
        ("\x01\x02\x03\x04,\x05", "not a text file"),
    ],
)
def test_faults_are_named_by_line_and_column(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        jeuler.read_trajectory(io.BytesIO(text.encode()))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_column_of_text_is_left_out():
    text = "t,x,remark\n" + "".join(f"{a},{b},ok\n" for a, b in zip(T, X, strict=True))
    assert list(jeuler.read_trajectory(io.StringIO(text)).columns) == ["x"]


def test_not_a_source():
    with pytest.raises(ValueError, match="a recording is a path, an open file or a pandas or polars frame, got int"):
        jeuler.read_trajectory(3)


@contextmanager
def counted_calls():
    """A list whose one number is how many Python and C functions were called."""
    count, before = [0], sys.getprofile()

    def called(frame, event, argument):
        count[0] += event in ("call", "c_call")

    sys.setprofile(called)
    try:
        yield count
    finally:
        sys.setprofile(before)


def test_the_work_grows_as_the_rows(random):
    """Calls, not seconds, which are those of the machine; benchmarks/recordings.py has the seconds."""
    calls = {}
    for rows in (10_000, 100_000):
        lines = "\n".join(f"{k / 100:.2f},{x:.6f}" for k, x in enumerate(random.standard_normal(rows)))
        source = io.StringIO("t,x\n" + lines)
        with counted_calls() as count:
            assert len(jeuler.read_trajectory(source).times) == rows
        calls[rows] = count[0]
    assert calls[100_000] < 10.1 * calls[10_000]
    assert calls[100_000] < 4 * 100_000


@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (["1,000.5", "999.25", "-12,345.5"], [1000.5, 999.25, -12345.5]),
        (["1.000,5", "999,25", "-12.345,5"], [1000.5, 999.25, -12345.5]),
    ],
)
def test_thousands_are_grouped_where_the_decimal_point_tells(cells, values):
    text = "t;x\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells))
    np.testing.assert_allclose(jeuler.read_trajectory(io.StringIO(text)).columns["x"], values)


def test_a_date_with_blanks_between_tabs_and_missing_cells():
    cells = [(f"{a:06.3f}", "#N/A" if k % 3 else str(b)) for k, (a, b) in enumerate(zip(T, X, strict=True))]
    text = "when\tx\n" + "".join(f"17/05/2024 16:38:{a}\t{b}\n" for a, b in cells)
    times, columns = jeuler.read_trajectory(io.StringIO(text))
    np.testing.assert_allclose(times, T, atol=1e-9)
    np.testing.assert_array_equal(columns["x"][::3], X[::3])


@pytest.mark.parametrize(
    ("name", "quantity"),
    [("Accelerometer.csv", "acceleration"), ("Gyroscope.csv", "angular velocity"), ("swing.csv", "position")],
)
def test_a_file_for_each_sensor_says_by_its_name_what_x_y_z_are(tmp_path, name, quantity):
    rows = "".join(f"{a},1,{b},2\n" for a, b in zip(T, X, strict=True))
    (tmp_path / name).write_text("seconds_elapsed,z,y,x\n" + rows)
    (recording,) = understand(read_table(tmp_path / name))
    assert {column.quantity for column in recording.columns} == {quantity}
    assert any("The file's name says" in note for note in recording.notes) == (quantity != "position")
