"""The recordings of tests/data and the measured files, by one command each."""

import json

import pytest
from records import RECORDINGS, five_minutes, measured

from jeuler.__main__ import main

OTHERS = ("two_carts_small_kd.csv",)


@pytest.fixture
def fitted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(path, *arguments):
        assert main(["fit", str(path), *arguments, "--json", "out.json"]) == 0
        return json.loads((tmp_path / "out.json").read_text())

    return run


@pytest.mark.parametrize("name", sorted(p.name for p in RECORDINGS.glob("*.[ct]*") if p.name not in OTHERS))
def test_every_quirk_by_the_plain_command(fitted, name):
    told = fitted(RECORDINGS / name, "--mass", "0.25")
    assert abs(told["springs"][0]["ks"] / 20 - 1) < 0.005
    assert abs(told["springs"][0]["kd"] / 0.05 - 1) < 0.05
    assert told["warnings"] == []


def test_two_carts(fitted):
    """Against bounded least squares by scipy, as tests/data/recordings/README.md has it."""
    edges = "1-anchor,1-2,2-anchor"
    told = fitted(RECORDINGS / "two_carts_small_kd.csv", "--mass", "0.4036,1", "--edges", edges)
    springs = {spring["edge"]: spring for spring in told["springs"]}
    for edge, ks, error, kd in (
        ("1-anchor", 3.115, 0.025, 0.002),
        ("1-2", 31.487, 0.012, 0.005),
        ("2-anchor", 3.144, 0.023, 0.014),
    ):
        assert abs(springs[edge]["ks"] - ks) < 2 * error
        assert springs[edge]["kd"] >= 0
        assert abs(springs[edge]["kd"] - kd) < 0.01
    assert abs(told["rms"] - 0.598) < 0.005


def test_five_minutes_of_a_phone(fitted, tmp_path):
    told = fitted(five_minutes(tmp_path), "--mass", "0.25")
    assert abs(told["springs"][0]["ks"] / 19.997 - 1) < 1e-3
    assert abs(told["springs"][0]["kd"] / 0.0025 - 1) < 0.01


def test_single_pendulum(fitted):
    told = fitted(measured("pendulum_single"), "--pendulum", "--to", "10", "--mass", "1")
    assert abs(told["modes"][0]["natural_frequency"] ** 2 - 64.1) < 0.3
    assert told["share_of_amplitude"] < 0.003


def test_double_pendulum(fitted):
    edges = "1-anchor,1-2,2-anchor"
    told = fitted(measured("pendulum_double"), "--from", "55", "--mass", "1,?", "--edges", edges)
    slow, fast = (mode["natural_frequency"] for mode in told["modes"])
    assert abs(slow / 5.68 - 1) < 0.005
    assert abs(fast / 12.63 - 1) < 0.005


def test_silverbox(fitted):
    told = fitted(measured("silverbox_multisine"), "--columns", "y_V", "--input", "u_V", "--cubic", "--mass", "1")
    assert abs(told["springs"][0]["ks"] / 1.841e5 - 1) < 0.01
    assert told["share_of_amplitude"] < 0.005


def test_sphere_tells_its_drags_apart(fitted):
    told = fitted(measured("sphere_in_water"), "--from", "0.75", "--friction", "compare")
    scores = {row["friction"]: row["score"] for row in told["comparison"]}
    assert scores["viscous"] > 10
    assert "quadratic" in told["friction"]
