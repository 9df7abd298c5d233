"""Runs on several devices equal those on one, however a batch is placed; tried in a process with eight."""

from pathlib import Path

from eight_devices import printed_by


def test_every_way_to_place_a_batch_gives_what_one_device_gives():
    assert len(printed_by(Path(__file__).with_name("on_a_mesh.py"))) == 11
