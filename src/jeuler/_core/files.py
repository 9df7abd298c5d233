"""Files are written whole or not at all, and only plain files are replaced."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8 by `write_atomically`, its line ends as they are."""

    def write(temporary: str) -> None:
        with open(temporary, "w", newline="", encoding="utf-8") as file:
            file.write(text)

    write_atomically(path, write)


def write_atomically(path: str | os.PathLike[str], write: Callable[[str], object]) -> None:
    """Let ``write(temporary_path)`` make a file, then move it to its place; a failure leaves what was there.

    A link is followed: what it points to is written, and the link stays. A device or a pipe is written into. A
    directory or a socket is refused.
    """
    target = os.path.realpath(os.fspath(path))
    check_output(path)
    if _is_stream(target):
        _write_into_stream(target, write)
        return
    folder, name = os.path.split(target)
    handle, temporary = tempfile.mkstemp(dir=folder, prefix=".jeuler-", suffix=os.path.splitext(name)[1])
    os.close(handle)
    try:
        write(temporary)
        os.chmod(temporary, _permissions(target))
        os.replace(temporary, target)
    except BaseException:
        os.unlink(temporary)
        raise


def check_output(path: str | os.PathLike[str]) -> None:
    """Refuse what cannot be written to, before any work is done for it.

    Raises: ValueError, for an empty path, a directory, a socket, a folder that is not there, a name that the file
      system does not take, a place where the user may not write.
    """
    given = os.fspath(path)
    if not given:
        raise ValueError("an output needs a file name, got an empty one")
    target = os.path.realpath(given)
    folder = os.path.dirname(target)
    try:
        mode = os.stat(target).st_mode if os.path.lexists(target) else None
    except OSError as error:
        raise ValueError(f"{given}: cannot be written: {error.strerror}") from None
    if mode is None:
        if not os.path.isdir(folder):
            raise ValueError(f"{given}: there is no folder {folder}; make it first")
        limit = os.pathconf(folder, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
        if len(os.fsencode(os.path.basename(target))) > limit:
            raise ValueError(f"{given}: the name is longer than the {limit} bytes that the folder takes")
    elif stat.S_ISDIR(mode):
        raise ValueError(f"{given}: is a folder; give the name of a file")
    elif not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode)):
        raise ValueError(f"{given}: is neither a file nor a pipe nor a device; give the name of a file")
    writable = os.access(target, os.W_OK) if _is_stream(target) else os.access(folder, os.W_OK)
    if not writable:
        raise ValueError(f"{given}: no permission to write there")


def _is_stream(target: str) -> bool:
    """Whether the path is a pipe or a device: something to write into, not to replace."""
    if not os.path.exists(target):
        return False
    mode = os.stat(target).st_mode
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode)


def _permissions(target: str) -> int:
    """Those of the file that is replaced, or else what the user's mask leaves."""
    if os.path.exists(target):
        return stat.S_IMODE(os.stat(target).st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def _write_into_stream(target: str, write: Callable[[str], object]) -> None:
    """The whole content first, then into the pipe or device; a pipe that nobody reads is refused, not waited for."""
    with tempfile.TemporaryDirectory() as folder:
        whole = os.path.join(folder, "content" + os.path.splitext(target)[1])
        write(whole)
        try:
            handle = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
        except OSError as error:
            reason = "no process reads this pipe" if stat.S_ISFIFO(os.stat(target).st_mode) else error.strerror
            raise ValueError(f"{target}: cannot be written: {reason}") from None
        if hasattr(os, "set_blocking"):
            os.set_blocking(handle, True)
        with open(handle, "wb") as stream, open(whole, "rb") as content:
            shutil.copyfileobj(content, stream)
