"""The benchmarks find all that they import from the library."""

import importlib
import pathlib
import sys

import pytest

FOLDER = pathlib.Path(__file__).resolve().parents[1] / "benchmarks"
PEERS = {"warp", "jax_md", "cmaes", "mujoco"}  # of the extra `benchmark`


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py")))
def test_a_benchmark_can_be_imported(name, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in PEERS:
            raise
    finally:
        for path in FOLDER.glob("*.py"):
            sys.modules.pop(path.stem, None)
