"""The first guess: frequency to a tenth of a line's width for any sampling, in memory that grows as the rows."""

import tracemalloc

import numpy as np
import pytest

from jeuler.fitting.oscillation import estimate_oscillation
from jeuler.fitting.spectrum import block_means, strong_lines


def swing(t, omega, decay=0.005, noise=0.0, seed=0):
    clean = 0.3 + 0.05 * np.exp(-decay * t) * np.cos(omega * t + 0.4)
    return clean + noise * np.random.default_rng(seed).standard_normal(len(t))


def sampled(kind, rows, random):
    even = np.arange(rows) / 60
    if kind == "jittered":
        return even + random.uniform(0, 0.01, rows)
    if kind == "random":
        return np.sort(random.uniform(0, rows / 60, rows))
    if kind == "gap":
        return even[(even < even[-1] / 3) | (even > even[-1] / 2)]
    if kind == "repeated":
        return np.repeat(even[::2], 2)[:rows]
    return even


@pytest.mark.parametrize("kind", ["even", "jittered", "random", "gap", "repeated"])
@pytest.mark.parametrize("rows", [100, 723, 18_000])
def test_frequency_to_a_tenth_of_a_line(kind, rows, random):
    t, omega = sampled(kind, rows, random), 8.94
    x = swing(t, omega, noise=1e-3)
    x[::17] = np.nan
    y = swing(t, omega, noise=1e-3, seed=1)
    guess = estimate_oscillation(t, np.stack([x, y, np.full(len(t), np.nan)], axis=1))
    assert abs(guess.angular_frequency - omega) * np.ptp(t) / (2 * np.pi) < 0.1


@pytest.mark.parametrize("rows", [723, 18_000])
def test_near_the_highest_frequency_that_the_sampling_shows(rows):
    t = np.arange(rows) / 60
    omega = 0.9 * np.pi * 60
    found = estimate_oscillation(t, swing(t, omega)[:, None]).angular_frequency
    assert abs(found - omega) * np.ptp(t) / (2 * np.pi) < 0.1


def test_decay():
    t = np.arange(250) / 25
    np.testing.assert_allclose(estimate_oscillation(t, swing(t, 9.0, 0.3)[:, None]).decay_rate, 0.3, rtol=0.1)


@pytest.mark.parametrize(("rows", "megabytes"), [(18_000, 30), (200_000, 300)])
def test_memory_grows_as_the_rows(rows, megabytes):
    t = np.arange(rows) / 100
    x = swing(t, 8.94, noise=1e-3)[:, None]
    estimate_oscillation(t[:600], x[:600])
    tracemalloc.start()
    estimate_oscillation(t, x)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < megabytes * 1e6


@pytest.mark.parametrize("values", [np.full((50, 2), 0.3), np.full((50, 1), np.nan), np.zeros((50, 0))])
def test_nothing_moves(values):
    with pytest.raises(ValueError, match="nothing moves"):
        estimate_oscillation(np.arange(50.0), values)


@pytest.mark.parametrize("decay", [0.0, 0.05, 0.3])
def test_one_mode_is_one_line_and_two_are_two(decay):
    t = np.arange(1000) / 50
    one = swing(t, 6.0, decay, noise=2e-4)
    assert len(strong_lines(t, one)) == 1
    two = strong_lines(t, one + 0.02 * np.cos(11.0 * t))
    assert sorted(round(omega) for omega, _ in two) == [6, 11]
    assert strong_lines(t, np.random.default_rng(3).standard_normal(len(t))) == []
    assert strong_lines(t, np.full(len(t), 0.3)) == []


def test_block_means_leave_out_what_is_missing():
    x = np.array([1.0, np.nan, 3.0, 5.0, np.nan, np.nan, 9.0])
    np.testing.assert_array_equal(block_means(x, 2), [1.0, 4.0, np.nan])
    assert block_means(x, 1) is x
