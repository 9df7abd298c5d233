"""Runs on several devices equal those on one, however a batch is placed; tried in a process with eight."""

import os
import subprocess
import sys
from pathlib import Path


def test_every_way_to_place_a_batch_gives_what_one_device_gives():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    script = Path(__file__).with_name("on_a_mesh.py")
    run = subprocess.run(
        [sys.executable, script], env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert len(run.stdout.splitlines()) == 11
