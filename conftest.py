"""Doctests run in float32, as users do, the tests in float64; a skip must be named in tests/skips.txt; what is fast."""

import os
import pathlib
import re

# Small matrices by one thread: two processes on two cores with two threads each wait for each other. Before NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most of the time is XLA's, and most programs run once: LLVM does not optimise them, nor those of processes that tests
# start. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 XLA_FLAGS=" " pytest` compiles as users do. Before JAX.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import jax
import pytest
from _pytest.doctest import DoctestItem

ROOT = pathlib.Path(__file__).resolve().parent
HASTE = "jax_disable_most_optimizations"
HASTY = jax.config.read(HASTE)
# XLA's older way to write loops takes half the time again, one piece of code less than many. Flags of your own stay;
# a version that is not known might stop at a flag it does not have.
if jax.__version__.startswith(("0.8.", "0.10.")):
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1")
NAMED_SKIPS = ROOT / "tests" / "skips.txt"
FAST = (
    "tests/_core",
    "tests/contact/test_colliders.py",
    "tests/fitting/test_trajectory.py",
    "tests/samplers",
    "tests/solving/test_scan.py",
    "tests/steps/test_explicit.py",
    "tests/test_api.py",
    "tests/test_contributing.py",
    "tests/test_skips.py",
)


@pytest.fixture(autouse=True)
def precision(request):
    if isinstance(request.node, DoctestItem):
        with jax.enable_x64(False):
            yield
    else:
        yield


def pytest_configure(config):
    config.addinivalue_line("markers", "fast: a subset of all kinds of tests that takes less than two minutes")
    config.addinivalue_line("markers", "optimised: compiled as for users, as it is about rounding, bits or speed")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Optimise programs of doctests and of tests marked ``optimised``, also in processes they start, and of no others.

    Neither kind finds the other's among those that JAX keeps.
    """
    hasty = HASTY and item.get_closest_marker("optimised") is None and not isinstance(item, DoctestItem)
    if jax.config.read(HASTE) != hasty:
        os.environ[HASTE.upper()] = str(int(hasty))
        jax.config.update(HASTE, hasty)
        jax.clear_caches()


def pytest_collection_modifyitems(items):
    """Mark what ``pytest -m fast`` runs."""
    for item in items:
        if item.path.is_relative_to(ROOT) and item.path.relative_to(ROOT).as_posix().startswith(FAST):
            item.add_marker("fast")


def unnamed_skips(skipped):
    """Those skips, (node id, reason), that tests/skips.txt does not name."""
    lines = [line for line in NAMED_SKIPS.read_text().splitlines() if line and not line.startswith("#")]
    named = [re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in lines]
    return [
        (node, reason)
        for node, reason in skipped
        if not any(node.startswith(start) and expected in reason for start, expected in named)
    ]


def pytest_terminal_summary(terminalreporter):
    """Name the skips that nobody has named, before pytest's closing line; they fail the run (below)."""
    unnamed = terminalreporter.config.stash.get(UNNAMED, [])
    for node, reason in unnamed:
        terminalreporter.write_line(f"SKIPPED without a line in tests/skips.txt: {node}: {reason}", red=True)


UNNAMED = pytest.StashKey[list]()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or hasattr(session.config, "workerinput"):
        return
    reports = reporter.stats.get("skipped", [])
    skipped = [(report.nodeid, str(getattr(report, "longrepr", ("", "", ""))[-1])) for report in reports]
    session.config.stash[UNNAMED] = unnamed_skips(skipped)
    if session.config.stash[UNNAMED] and exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
