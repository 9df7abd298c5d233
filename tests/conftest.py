"""Shared fixtures. Tests run in float64 unless they say float32: ``dtype`` is the fixture for both."""

import gc

import jax
import numpy as np
import pytest
from compiling import compiled_programs
from records import sphere_in_water as sphere_in_water

jax.config.update("jax_enable_x64", True)

# What jax keeps of compiled programs is many objects and hardly any of them dies: look for cycles less often.
gc.set_threshold(100_000, 20, 100)


@pytest.fixture
def random():
    """A NumPy generator with a fixed seed."""
    return np.random.default_rng(20240229)


@pytest.fixture
def compiled():
    """A list that grows by the seconds of each program that is compiled."""
    with compiled_programs() as seconds:
        yield seconds


collect_ignore = ["_jax/on_a_mesh.py", "particles/on_devices.py"]  # programs that tests run with eight devices
