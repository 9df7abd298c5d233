"""Recordings for tests: the measured ones beside the repository, and synthetic ones of the same kind for every clone."""

import pathlib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

DATA = pathlib.Path(__file__).resolve().parent / "data"
MEASURED = DATA.parent.parent.parent / "shared" / "data"
RECORDINGS = DATA / "recordings"  # their truths: README.md there

# A sphere of 1 kg on a spring in water: N/m, kg/s, kg/m, m
SPHERE = {"ks": 22.6, "kd": 0.2, "coefficient": 7.2, "anchor": 0.2153, "start": 0.2892}


def measured(name):
    """The path of a measured recording; a test that needs it is skipped where it is absent."""
    if not MEASURED.is_dir():
        pytest.skip("needs the measured recordings in ../shared/data")
    return MEASURED / f"{name}.csv"


def synthetic_sphere(folder):
    """The path of a synthetic `sphere_in_water`: released at 0.5 s, video at 120 Hz, pixels of 0.31 mm, noise of 0.5 mm."""
    t = np.round(0.467 + np.arange(757) / 120, 3)
    s = SPHERE

    def field(t, y):
        x, v = y
        return v, -s["ks"] * (x - s["anchor"]) - s["kd"] * v - s["coefficient"] * abs(v) * v

    run = solve_ivp(field, (0.5, t[-1]), [s["start"], 0.0], t_eval=t[t >= 0.5], method="DOP853", rtol=1e-10, atol=1e-12)
    x = np.concatenate([np.full(np.count_nonzero(t < 0.5), s["start"]), run.y[0]])
    x = x + np.random.default_rng(7).normal(0, 5e-4, len(x))
    pixel = 3.1115e-4
    path = pathlib.Path(folder) / "synthetic_sphere.csv"
    header = "synthetic: tests/records.py\ncolumns: t_s,x_m"
    np.savetxt(path, np.stack([t, np.round(x / pixel) * pixel], 1), fmt=["%.3f", "%.7f"], delimiter=",", header=header)
    return path


def five_minutes(folder):
    """The path of 18,000 rows at 60 Hz of the oscillation that tests/data/recordings/README.md describes."""
    t = np.arange(18_000) / 60
    x = 0.3 + 0.05 * np.exp(-0.005 * t) * np.cos(8.9437 * t) + np.random.default_rng(8).normal(0, 2e-4, len(t))
    path = pathlib.Path(folder) / "five_minutes_60Hz.csv"
    np.savetxt(path, np.stack([t, x], 1), fmt=["%.5f", "%.6f"], delimiter=",", header="t,x", comments="")
    return path


@pytest.fixture(params=["measured", "synthetic"])
def sphere_in_water(request, tmp_path):
    """The path of a recording of a sphere in water, measured or synthetic."""
    return measured("sphere_in_water") if request.param == "measured" else synthetic_sphere(tmp_path)
