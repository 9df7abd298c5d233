"""The programs of the pages for two hosts and for a sweep by Dask, on loopback, print what the pages say."""

import os
import pathlib
import re
import socket
import subprocess
import sys

import numpy as np

PAGES = pathlib.Path(__file__).resolve().parents[2] / "docs" / "howto"
# two processes on two cores, in the precision of the pages
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("JAX_ENABLE_X64", "XLA_FLAGS")}


def program_of(page, folder):
    """The page's program, written to the folder, and what the page says that it prints."""
    text = (PAGES / page).read_text()
    path = folder / re.search(r"```python\n# (\w+\.py)\n", text)[1]
    path.write_text(re.search(r"```python\n(.*?)```", text, re.S)[1])
    return path, re.search(r"```\n([^`]*\d[^`]*)```\n", text)[1]


def started(path, *given):
    return subprocess.Popen(
        [sys.executable, path.name, *given], cwd=path.parent, env=ENVIRONMENT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def numbers(text):
    return sorted(float(x) for x in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text))


def test_two_processes_reduce_one_ensemble(tmp_path):
    path, says = program_of("two_hosts.md", tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    both = [started(path, str(number), address) for number in (0, 1)]
    try:
        printed, problem = both[0].communicate(timeout=120)
        assert both[0].returncode == 0, problem[-2000:]
        assert both[1].wait(timeout=60) == 0
    finally:
        for process in both:
            process.kill()
            process.communicate()
    lines = [line for line in printed.splitlines() if not line.startswith("[Gloo]")]
    assert lines[0] == says.splitlines()[0] == "2 processes, 2 devices"
    np.testing.assert_allclose(numbers(lines[1]), numbers(says.splitlines()[1]), atol=2e-5)


def test_dask_hands_out_ensembles(tmp_path):
    path, says = program_of("sweep.md", tmp_path)
    process = started(path)
    try:
        printed, problem = process.communicate(timeout=180)
    finally:
        process.kill()
    assert process.returncode == 0, problem[-2000:]
    np.testing.assert_allclose(numbers(printed), numbers(says), atol=1e-5)
