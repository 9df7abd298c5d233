"""Outputs: whole or not at all; links followed, pipes and devices written into, folders refused."""

import os
import pathlib
import socket
import subprocess
import sys
import threading

import pytest

from jeuler._core import files
from jeuler._core.files import check_output, write_atomically


def writes(text):
    def write(path):
        with open(path, "w") as file:
            file.write(text)

    return write


def test_plain_file_is_replaced_and_keeps_its_permissions(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    write_atomically(path, writes("new"))
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["a.txt"]


def test_failure_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fails(temporary):
        writes("half")(temporary)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fails)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("there", [True, False])
def test_link_is_followed_and_stays(tmp_path, there):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    if there:
        target.write_text("old")
    link.symlink_to("target.txt")
    write_atomically(link, writes("new"))
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_pipe_is_written_into(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    handle = os.open(pipe, os.O_WRONLY)  # waits for the reader
    write_atomically(pipe, writes("new" * 100_000))
    os.close(handle)
    reader.join(10)
    assert got == ["new" * 100_000]
    assert pipe.is_fifo()


def test_pipe_that_nobody_reads_is_refused(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ValueError, match="no process reads this pipe"):
        write_atomically(pipe, writes("new"))
    assert pipe.is_fifo()


def test_device_is_written_into():
    before = os.stat("/dev/null")
    write_atomically("/dev/null", writes("new"))
    after = os.stat("/dev/null")
    assert (before.st_mode, before.st_rdev, before.st_ino) == (after.st_mode, after.st_rdev, after.st_ino)


def test_refused_before_any_work(tmp_path):
    (tmp_path / "folder").mkdir()
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "socket"))
    (tmp_path / "loop").symlink_to("loop")
    for path, message in [
        ("", "empty"),
        (tmp_path / "folder", "is a folder"),
        (tmp_path / "absent" / "a.txt", "there is no folder"),
        (tmp_path / "socket", "neither a file nor a pipe nor a device"),
        (tmp_path / ("a" * 300), "the name is longer"),
        (tmp_path / "loop", "cannot be written"),
    ]:
        with pytest.raises(ValueError, match=message):
            check_output(path)
        with pytest.raises(ValueError, match=message):
            write_atomically(path, writes("new"))
    server.close()
    assert sorted(os.listdir(tmp_path)) == ["folder", "loop", "socket"]


def test_longest_name(tmp_path):
    path = tmp_path / ("a" * 251 + ".txt")
    write_atomically(path, writes("new"))
    assert path.read_text() == "new"


def test_a_kill_in_the_middle_leaves_what_was_there(tmp_path):
    """A process of its own that ends without any clean-up while it writes, and one just before the file takes its place."""
    source = pathlib.Path(files.__file__)
    for ending in ("os._exit(9)", "module.os.replace = lambda *_: os._exit(9)"):
        (tmp_path / "out.json").write_text("old")
        code = f"""
import importlib.util, os
spec = importlib.util.spec_from_file_location("files", {str(source)!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
def write(path):
    open(path, "w").write("half of it")
    {ending}
module.write_atomically("out.json", write)
"""
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
        assert done.returncode == 9
        assert (tmp_path / "out.json").read_text() == "old"
