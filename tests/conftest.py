"""Shared fixtures. Tests run in float64 unless they say float32: ``dtype`` is the fixture for both."""

import gc
import pathlib

import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)

# What jax keeps of compiled programs is many objects and hardly any of them dies: look for cycles less often.
gc.set_threshold(100_000, 20, 100)

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
