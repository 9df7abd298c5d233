"""Marker files of motion capture, and old workbooks: the numbers that were written, or one line that says why not."""

import contextlib
import io

import c3d
import numpy as np
import pytest
import xlwt

import jeuler
from jeuler.fitting.recordings.reading import read_table

T = np.arange(50) / 100
X = np.round(300 + 50 * np.cos(9 * T), 3)


def trc(cell="0.000\t{:.3f}\t5.000", ends="\n"):
    """Two markers, LKNE moving along x and V moving along y; V is lost in row 8."""
    head = [
        "PathFileType\t4\t(X/Y/Z)\tswing.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        "100.00\t100.00\t50\t2\tmm\t100.00\t1\t50",
        "Frame#\tTime\tLKNE\t\t\tV\t\t",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        "",
    ]
    rows = [
        f"{k + 1}\t{t:.3f}\t{x:.3f}\t100.000\t7.000\t" + ("\t\t" if k == 7 else cell.format(x))
        for k, (t, x) in enumerate(zip(T, X, strict=True))
    ]
    return ends.join([*head, *rows]) + ends


def c3d_bytes():
    """The same as a .c3d file."""
    writer = c3d.Writer(point_rate=100.0, point_units="mm")
    for k, x in enumerate(X):
        points = np.zeros((2, 5), np.float32)
        points[:, :3] = [[x, 100, 7], [0, x, 5]]
        points[1, 3] = -1 if k == 7 else 0
        writer.add_frames([(points, np.zeros((0, 0)))])
    writer.set_point_labels(["LKNE", "V"])
    file = io.BytesIO()
    with pytest.warns(UserWarning, match="No analog data"):
        writer.write(file)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["trc", "trc of Windows", "c3d"])
def test_markers_have_names_axes_units_and_gaps(tmp_path, kind):
    path = tmp_path / "swing"
    path.write_bytes({"trc": trc().encode(), "trc of Windows": trc(ends="\r\n").encode()}.get(kind) or c3d_bytes())
    times, columns = jeuler.read_trajectory(path, si=True)
    np.testing.assert_allclose(times, T, atol=1e-9)
    names = [name for name in columns if name != "Frame"]
    assert names == [f"{axis} {marker} (mm)" for marker in ("LKNE", "V") for axis in "xyz"]
    np.testing.assert_allclose(columns["x LKNE (mm)"], X / 1000, rtol=1e-6)
    lost = np.isnan(columns["y V (mm)"])
    assert lost.tolist() == [k == 7 for k in range(50)]
    np.testing.assert_allclose(columns["y V (mm)"][~lost], X[~lost] / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (trc("0.000\thigh{:.0f}\t5.000"), r"line 7: column 7 \(y V \(mm\)\): expected a number, got 'high350'"),
        (trc().replace("Frame#\tTime", "LKNE\tV"), r"line 4: expected Frame#, Time and the markers"),
        ("\n".join(trc().split("\n")[:5]), r"line 5: the header of a .trc file has 5 lines"),
        (trc()[:-30], r"line 56: \d cells, expected 8"),
    ],
)
def test_a_damaged_marker_file_is_refused_with_its_line(text, message):
    with pytest.raises(ValueError, match=message):
        read_table(io.StringIO(text))


def test_a_damaged_c3d_file_is_refused():
    raw = c3d_bytes()
    with pytest.raises(ValueError, match=r"holds \d+ of 50 frames of 2 markers at 100 Hz; copy it again"):
        read_table(io.BytesIO(raw[:2000]))
    random = np.random.default_rng(17)
    for _ in range(30):
        damaged = bytearray(raw)
        for place in random.integers(0, 1500, 20):
            damaged[place] = random.integers(0, 256)
        with contextlib.suppress(ValueError):  # any other exception fails
            assert read_table(io.BytesIO(bytes(damaged))).values.shape == (50, 7)


def test_old_workbook(tmp_path):
    """As phyphox writes it: the data on the first sheet, what the phone knows of itself on others."""
    book = xlwt.Workbook()
    sheet = book.add_sheet("Raw Data")
    for k, name in enumerate(("Time (s)", "Linear Acceleration x (m/s^2)")):
        sheet.write(0, k, name)
        for row, value in enumerate((T, X)[k], 1):
            sheet.write(row, k, float(value))
    book.add_sheet("Metadata Device").write(0, 0, "property")
    book.save(str(tmp_path / "a.xls"))
    times, columns = jeuler.read_trajectory(tmp_path / "a.xls")
    np.testing.assert_array_equal(times, T)
    np.testing.assert_array_equal(columns["Linear Acceleration x (m/s^2)"], X)
    raw = (tmp_path / "a.xls").read_bytes()
    for cut in (600, len(raw) // 2):
        (tmp_path / "b.xls").write_bytes(raw[:cut])
        with pytest.raises(ValueError, match=r"b.xls: the workbook cannot be read .*; save the sheet as CSV"):
            jeuler.read_trajectory(tmp_path / "b.xls")
