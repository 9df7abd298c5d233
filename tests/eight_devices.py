"""Programs that need several devices: run in a process of their own, with eight forced on the host."""

import os
import subprocess
import sys


def printed_by(script):
    """The lines that a program prints there; fails with the end of its complaint where it fails."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    run = subprocess.run(
        [sys.executable, script], env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return run.stdout.splitlines()
