"""Shared fixtures. Tests run in float64 unless they say float32: ``dtype`` is the fixture for both."""

import pathlib

import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)

SHARED = pathlib.Path(__file__).resolve().parent.parent.parent / "shared"


@pytest.fixture
def random():
    """A NumPy generator with a fixed seed."""
    return np.random.default_rng(20240229)


@pytest.fixture
def shared():
    """The folder of measured data and published references; a test that needs it says so when it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the measured data and published references in {SHARED}")
    return SHARED
