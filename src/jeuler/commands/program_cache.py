"""The programs that the command line compiled, kept in the user's cache folder for its next run."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import sys
from pathlib import Path

import jax
import jaxlib

from jeuler._core.precision import setting

MOST = 200 * 2**20  # bytes kept; the least recently used go first


def keep_programs() -> Path | None:
    """Let JAX store compiled programs below `folder` and read them there; returns the place, or None if it does not.

    It does not where JAX has a folder already (``JAX_COMPILATION_CACHE_DIR``), where its cache is switched off
    (``JAX_ENABLE_COMPILATION_CACHE=0``), or where nothing can be written.
    """
    has_one = setting("jax_compilation_cache_dir")
    if has_one or not setting("jax_enable_compilation_cache"):
        return None
    place = folder() / of_this_machine()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(place, os.W_OK):
        return None
    shorten(folder(), MOST)
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return place


def folder() -> Path:
    """Where programs are kept: ``jeuler`` in the user's cache folder of this operating system."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    else:
        base = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "jeuler"


def of_this_machine() -> str:
    """A name for these versions and this processor: programs are machine code, and machines may share a home."""
    about = [jax.__version__, jaxlib.__version__, platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        pass
    return f"jax-{jax.__version__}-{hashlib.sha256(repr(about).encode()).hexdigest()[:12]}"


def shorten(place: Path, most: int) -> None:
    """Remove the least recently used files of a folder until the others are at most so many bytes."""
    files = []
    for file in place.rglob("*"):
        try:
            about = file.stat()
        except OSError:  # another run has just removed it
            continue
        if file.is_file():
            files.append((max(about.st_atime, about.st_mtime), about.st_size, file))
    total = 0
    for _, size, file in sorted(files, reverse=True):
        total += size
        if total > most:
            with contextlib.suppress(OSError):  # in use, or not ours
                file.unlink(missing_ok=True)
