"""What a column's name says: quantity, unit, axis, run."""

import numpy as np
import pytest

from jeuler.fitting.recordings.units import axis_of, is_unit, quantity_of, split_run, split_unit, unit_of


@pytest.mark.parametrize(
    ("name", "quantity", "unit", "axis"),
    [
        ("t", "time", "", ""),
        ("t_s", "time", "s", ""),
        ("Time (s)", "time", "s", ""),
        ("Time [ms]", "time", "ms", ""),
        ("t / ms", "time", "ms", ""),
        ("t in ms", "time", "ms", ""),
        ("Time, ms", "time", "ms", ""),
        ("timestamp", "time", "", ""),
        ("millis", "time", "", ""),
        ("seconds_elapsed", "time", "", ""),
        ("x", "position", "", "x"),
        ("x1", "position", "", "x"),
        ("X (mm)", "position", "mm", "x"),
        ("x_m", "position", "m", "x"),
        ("Position, Ch 1+2 (m)", "position", "m", ""),
        ("Ultrasonic distance / cm", "position", "cm", ""),
        ("v", "velocity", "", ""),
        ("vx", "velocity", "", "x"),
        ("Velocity (m/s) Run #2", "velocity", "m/s", ""),
        ("Data Set 1:Acceleration(m/s²)", "acceleration", "m/s²", ""),
        ("Linear Acceleration x (m/s^2)", "acceleration", "m/s^2", "x"),
        ("Acceleration y (m s^-2)", "acceleration", "m s^-2", "y"),
        ("accel_z", "acceleration", "", "z"),
        ("ax", "acceleration", "", "x"),
        ("gFy", "acceleration", "", "y"),
        ("TgF", "absolute", "", ""),
        ("Absolute acceleration (m/s^2)", "absolute", "m/s^2", ""),
        ("|a|", "absolute", "", ""),
        ("x uncertainty (m)", "uncertainty", "m", "x"),
        ("theta_rad", "angle", "rad", ""),
        ("theta1_rad", "angle", "rad", ""),
        ("Angle (deg)", "angle", "deg", ""),
        ("omega", "angular velocity", "", ""),
        ("omega_radps", "angular velocity", "radps", ""),
        ("Gyroscope x (rad/s)", "angular velocity", "rad/s", "x"),
        ("Force (N)", "force", "N", ""),
        ("frame", "index", "", ""),
        ("u_V", "", "V", ""),
    ],
)
def test_names(name, quantity, unit, axis):
    assert quantity_of(name) == quantity
    assert split_unit(split_run(name)[0])[1] == unit
    assert axis_of(name)[0] == axis


@pytest.mark.parametrize(
    ("unit", "quantity", "factor"),
    [
        ("ms", "time", 1e-3),
        ("[µs]", "time", 1e-6),
        ("(mm)", "position", 1e-3),
        ("m/s²", "acceleration", 1.0),
        ("m·s⁻²", "acceleration", 1.0),
        ("m/s/s", "acceleration", 1.0),
        ("m/s**2", "acceleration", 1.0),
        ("m/s2", "acceleration", 1.0),
        ("ms^-1", "velocity", 1.0),
        ("g", "acceleration", 9.80665),
        ("°", "angle", np.pi / 180),
        ("deg/s", "angular velocity", np.pi / 180),
        ("rpm", "angular velocity", np.pi / 30),
        ("km/h", "velocity", 1 / 3.6),
    ],
)
def test_units(unit, quantity, factor):
    found = unit_of(unit)
    assert found is not None
    assert found[0] == quantity
    np.testing.assert_allclose(found[1], factor)


@pytest.mark.parametrize("text", ["", "x", "Ch 1+2", "furlong", "hello", "1.5"])
def test_no_units(text):
    assert not is_unit(text)


@pytest.mark.parametrize(
    ("name", "rest", "run"),
    [
        ("Time (s) Run #1", "Time (s)", "1"),
        ("Run 12: Position (m)", "Position (m)", "12"),
        ("Data Set 2:Time(s)", "Time(s)", "2"),
        ("Latest: x (m)", "x (m)", "latest"),
        ("x (m)", "x (m)", ""),
        ("Run 1", "Run 1", ""),
    ],
)
def test_runs(name, rest, run):
    assert split_run(name) == (rest, run)


@pytest.mark.parametrize(
    ("name", "marker"), [("x1", "1"), ("x_A", "a"), ("y2", "2"), ("x", ""), ("ball x (m)", "ball")]
)
def test_particles(name, marker):
    assert axis_of(name)[1] == marker
