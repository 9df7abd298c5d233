"""Arguments are taken into another precision whole: numbers, complex numbers, integers of 64 bits, keys."""

import jax
import numpy as np
import pytest

from jeuler._core.precision import cast

GIVEN = {
    "real": np.float64(0.1),
    "complex": np.complex128(0.1 + 0.2j),
    "index": np.array([3, -1], np.int64),
    "count": np.uint64(7),
    "far": np.array([2**40, 1]),
    "flag": np.True_,
    "small": np.int8(5),
    "key": jax.random.key(1),
}


@pytest.mark.parametrize(
    ("dtype", "kinds"),
    [
        (np.float32, "float32 complex64 int32 uint32 int64 bool int8"),
        (np.float64, "float64 complex128 int64 uint64 int64 bool int8"),
    ],
)
def test_arguments_in_another_precision(dtype, kinds):
    found = cast(GIVEN, dtype)
    assert [str(np.asarray(found[name]).dtype) for name in list(GIVEN)[:-1]] == kinds.split()
    assert found["key"] is GIVEN["key"]
    for name in "index", "count", "far", "flag", "small":
        np.testing.assert_array_equal(found[name], GIVEN[name])
