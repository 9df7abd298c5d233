"""Shared fixtures. Tests run in float64 unless they say float32: ``dtype`` is the fixture for both."""

import gc

import jax
import numpy as np
import pytest
from records import sphere_in_water as sphere_in_water

jax.config.update("jax_enable_x64", True)

# What jax keeps of compiled programs is many objects and hardly any of them dies: look for cycles less often.
gc.set_threshold(100_000, 20, 100)


@pytest.fixture
def random():
    """A NumPy generator with a fixed seed."""
    return np.random.default_rng(20240229)


LISTENING = []  # lists of seconds; JAX 0.8 has no way to take a listener back


def _listen(name, duration, **_):
    if name == "/jax/core/compile/backend_compile_duration":
        for seconds in LISTENING:
            seconds.append(duration)


jax.monitoring.register_event_duration_secs_listener(_listen)


@pytest.fixture
def compiled():
    """A list that grows by the seconds of each program that is compiled."""
    seconds = []
    LISTENING.append(seconds)
    yield seconds
    LISTENING.pop()


collect_ignore = ["_jax/on_a_mesh.py", "particles/on_devices.py"]  # programs that tests run with eight devices
