"""The list of tests that may be skipped, tests/skips.txt, and what the run makes of it."""

import importlib.util
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def conftest():
    spec = importlib.util.spec_from_file_location("root_conftest", ROOT / "conftest.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NAMED = "tests/fitting/test_springs.py::test_sphere_in_water[measured-False]"
REASON = "Skipped: needs the measured recordings in ../shared/data"


@pytest.mark.parametrize(
    ("node", "reason", "allowed"),
    [
        (NAMED, REASON, True),
        (NAMED, "Skipped: another reason", False),
        (NAMED.replace("measured", "synthetic"), REASON, False),
        ("tests/fitting/test_springs.py::test_another", REASON, False),
    ],
)
def test_a_skip_is_allowed_by_its_name_and_its_reason(conftest, node, reason, allowed):
    assert conftest.unnamed_skips([(node, reason)]) == ([] if allowed else [(node, reason)])


def test_every_line_names_a_file_that_is_there(conftest):
    lines = [line for line in conftest.NAMED_SKIPS.read_text().splitlines() if line and not line.startswith("#")]
    assert lines
    for line in lines:
        assert (ROOT / line.split()[0].partition("::")[0]).is_file()


def test_what_is_fast_is_there(conftest):
    assert all((ROOT / path).exists() for path in conftest.FAST)
