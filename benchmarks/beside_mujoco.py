"""The fit of docs/beside_mujoco.md by mujoco.sysid and by jeuler: the page's own code, its lines, seconds and errors.

    pip install 'mujoco[sysid]'
    python benchmarks/beside_mujoco.py

Each runs in a process of its own, without a compilation cache, after the data were made and the imports were done.
"""

import importlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

PAGE = pathlib.Path(__file__).parent.parent / "docs" / "beside_mujoco.md"


def blocks():
    """The code of the page: data, mujoco.sysid, jeuler."""
    data, mujoco, jeuler = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return {"data": data, "mujoco": mujoco, "jeuler": jeuler}


def one(tool):
    """One fit in this process; prints its numbers."""
    code = blocks()
    names = {}
    exec(code["data"], names)
    for module in {"mujoco": ("mujoco", "mujoco.sysid", "mujoco.sysid.report"), "jeuler": ("jeuler",)}[tool]:
        importlib.import_module(module)
    for module in ("scipy.interpolate", "scipy.optimize", "scipy.sparse.linalg", "scipy.stats", "matplotlib.pyplot"):
        importlib.import_module(module)
    if tool == "jeuler":
        import jax

        jax.config.update("jax_enable_x64", True)
        getattr(importlib.import_module("jeuler"), "fit_springs")  # noqa: B009  # loads what fits
    fitting, writing = re.split(r"\n(?=report = |found\.report)", code[tool])
    out, busy = sys.stdout, time.process_time()
    sys.stdout = sys.stderr
    begun = time.perf_counter()
    exec(fitting, names)
    fitted = time.perf_counter()
    exec(writing, names)
    written, busy = time.perf_counter(), time.process_time() - busy
    sys.stdout = out
    truth = {"ks": "KS", "kd": "KD", "delay": "DELAY", "gain": "GAIN"}
    errors = {name: float(names["values"][name]) - names[true] for name, true in truth.items()}
    print(json.dumps({"fit": fitted - begun, "report": written - fitted, "cpu": busy, "errors": errors}))


def main():
    code = blocks()
    for tool in ("mujoco", "jeuler"):
        lines = sum(bool(line.strip()) for line in code[tool].splitlines())
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": ""}
            done = subprocess.run(
                [sys.executable, os.path.abspath(__file__), tool],
                capture_output=True, text=True, cwd=folder, env=environment,
            )  # fmt: skip
        if done.returncode:
            sys.exit(done.stderr)
        found = json.loads(done.stdout.splitlines()[-1])
        errors = ", ".join(f"{name} {error:+.2g}" for name, error in found["errors"].items())
        print(
            f"{tool:<7} {lines} lines, fit {found['fit']:.2f} s, report {found['report']:.2f} s, "
            f"{found['cpu']:.2f} s of CPU; off by {errors}"
        )


if __name__ == "__main__":
    one(sys.argv[1]) if len(sys.argv) > 1 else main()
