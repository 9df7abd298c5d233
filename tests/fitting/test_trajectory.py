"""read_trajectory: what labs and phones write, and one clear line for what cannot be read."""

import numpy as np
import pytest
from records import measured, synthetic_sphere

import jeuler


def write(tmp_path, text, name="data.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "t,x1,y1\n0,1,2\n0.5,3,\n",
        "t;x1;y1\n0;1;2\n0,5;3;\n",
        "t\tx1\ty1\r\n0\t1\t2\r\n0,5\t3\tNaN\r\n",
        "t x1 y1\n0 1 2\n0.5 3 nan\n",
        "# made by hand\nt,x1,y1\n# a remark\n0,1,2\n\n0.5,3,NA\n",
        "\ufefft,x1,y1\n0,1,2\n0.5,3,\n",
        '"t","x1","y1"\n"0","1,0","2"\n"0,5","3",""\n',
        "t,x1,y1\ns,m,m\n0,1,2\n0.5,3,-\n",
        "# columns: t,x1,y1\n0,1,2\n0.5,3,\n",
        "t,x1,y1\n0,1,2,\n0.5,3,,\n",
        "x1,t,y1\n1,0,2\n3,0.5,\n",
        "t,x1,y1\n0,1.0e0,+2\n5E-1,.3e1,null\n",
    ],
)
def test_reads(tmp_path, text):
    times, columns = jeuler.read_trajectory(write(tmp_path, text))
    assert times.tolist() == [0, 0.5]
    assert list(columns) == ["x1", "y1"]
    np.testing.assert_array_equal(columns["x1"], [1, 3])
    np.testing.assert_array_equal(columns["y1"], [2, np.nan])


def test_no_header(tmp_path):
    trajectory = jeuler.read_trajectory(write(tmp_path, "0,1,2\n0.5,3,4\n"))
    assert list(trajectory.columns) == ["column2", "column3"]
    assert trajectory.times.tolist() == [0, 0.5]


def test_phone_header_with_commas_and_units(tmp_path):
    text = '"Time (s)","Linear Acceleration x (m/s^2)"\n0.00E0,1.25E-1\n1.00E-2,2.5E-1\n'
    times, columns = jeuler.read_trajectory(write(tmp_path, text))
    assert times.tolist() == [0, 0.01]
    assert columns["Linear Acceleration x (m/s^2)"].tolist() == [0.125, 0.25]


def test_latin_header_and_repeated_names(tmp_path):
    _, columns = jeuler.read_trajectory(write(tmp_path, "t;Höhe µm;Höhe µm\n0;1;2\n", encoding="latin-1"))
    assert list(columns) == ["Höhe µm", "Höhe µm_3"]


def test_named_time(tmp_path):
    path = write(tmp_path, "x,clock\n1,0\n2,1\n")
    assert jeuler.read_trajectory(path, time="clock").times.tolist() == [0, 1]
    with pytest.raises(ValueError, match="no column 'when' for the time, the columns are x, clock"):
        jeuler.read_trajectory(path, time="when")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,1\n1,high\n", r"data.csv: line 3: column 2 \(x\): expected a number, got 'high'"),
        ("t,x\n0,1\n1,inf\n", r"line 3: column 2 \(x\): expected a number, got 'inf'"),
        ("t,x\n0,1\n\n1\n", "line 4: 1 cell, expected 2: t, x"),
        ("t,x\n0,1\n1,2,3\n", "line 3: 3 cells, expected 2"),
        ("t,x\n0,1\n,2\n", r"line 3: column 1 \(t\): the time is missing"),
        ("", "no data"),
        ("# only a remark\n", "no data"),
        ("t,x\n", "line 1: only names and no numbers"),
        ("1\n2\n", "line 1: one column"),
        ("a\0b", "not a text file"),
    ],
)
def test_cannot_read(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        jeuler.read_trajectory(write(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["sphere_in_water", "pendulum_single", "pendulum_double", "silverbox_multisine"])
def test_reads_the_measured_files_as_numpy_does(name):
    assert_read_as_numpy_does(measured(name))


def test_reads_synthetic_files_as_numpy_does(tmp_path):
    assert_read_as_numpy_does(synthetic_sphere(tmp_path))
    state = np.random.default_rng(3).normal(size=(500, 5)).round(6)
    state[:, 0] = np.arange(500) / 100
    path = tmp_path / "pendulum.csv"
    np.savetxt(
        path, state, fmt="%.6f", delimiter=",", header="synthetic\ncolumns: t_s,theta1_rad,theta2_rad,omega1,omega2"
    )
    assert_read_as_numpy_does(path)


def assert_read_as_numpy_does(path):
    times, columns = jeuler.read_trajectory(path)
    table = np.genfromtxt(path, delimiter=",", comments="#")
    np.testing.assert_array_equal(times, table[:, 0])
    np.testing.assert_array_equal(np.stack(list(columns.values()), axis=1), table[:, 1:])
