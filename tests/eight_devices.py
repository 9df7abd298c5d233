"""Programs that need several devices: run in a process of their own, with eight forced on the host."""

import os
import subprocess
import sys


def printed_by(script, *given):
    """The lines that a program prints there, given these arguments; fails with the end of its complaint where it fails.

    Compiled with little optimisation, as nothing runs for long.
    """
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    flags += " --xla_force_host_platform_device_count=8"
    run = subprocess.run(
        [sys.executable, script, *given], env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return run.stdout.splitlines()
