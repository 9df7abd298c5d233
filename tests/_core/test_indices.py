"""Indices of particles as a component keeps them."""

import numpy as np
import pytest

from jeuler._core.indices import different_particles


@pytest.mark.parametrize("given", [[2, 0, 1], (2, 0, 1), np.array([2, 0, 1]), range(2, -1, -1)])
def test_particles_from_any_sequence(given):
    assert len(different_particles("Body.particles", given)) == 3
    assert different_particles("Body.particles", given)[0] == 2
    assert len(different_particles("Body.particles", given[:0])) == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (3, r"Body\.particles must have shape \(particle,\), got \(\)"),
        ([[0, 1]], r"Body\.particles must have shape \(particle,\), got \(1, 2\)"),
        ([4, 1, 4], r"Body\.particles must be different particles, got 4 twice"),
        ([0, -1], r"Body\.particles must be integers, particle indices from 0"),
        ([0.5], r"Body\.particles must be integers, particle indices, got float64"),
    ],
)
def test_what_names_no_particles_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        different_particles("Body.particles", given)
