"""Doctests run in float32, as users do; the tests themselves in float64 (tests/conftest.py)."""

import jax
import pytest
from _pytest.doctest import DoctestItem


@pytest.fixture(autouse=True)
def precision(request):
    if isinstance(request.node, DoctestItem):
        with jax.enable_x64(False):
            yield
    else:
        yield
