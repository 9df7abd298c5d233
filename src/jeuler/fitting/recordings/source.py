"""Where a recording comes from: a path, a file object, compressed or not, a workbook, a frame."""

from __future__ import annotations

import codecs
import gzip
import io
import os
import zipfile
import zlib
from typing import Any

MOST_BYTES = 1_000_000_000
MARKS = (  # byte-order marks, the longer first
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
COMPOUND, ZIP, GZIP = b"\xd0\xcf\x11\xe0", b"PK\x03\x04", b"\x1f\x8b"


def content(source: Any) -> tuple[str, bytes | str]:
    """Name and content of a path or an open file, unpacked."""
    if hasattr(source, "read"):
        name = getattr(source, "name", None)
        raw = source.read()
        name = name if isinstance(name, str) else "the open file"
        if not isinstance(raw, (bytes, str)):
            raise ValueError(f"{name}: expected an open file of text or bytes, got one of {type(raw).__name__}")
    else:
        try:
            name = os.fsdecode(os.fspath(source))
        except TypeError:
            raise ValueError(
                f"a recording is a path, an open file or a pandas or polars frame, got {type(source).__name__}"
            ) from None
        with open(name, "rb") as file:
            raw = file.read(MOST_BYTES + 1)
    if len(raw) > MOST_BYTES:
        raise ValueError(f"{name}: more than {MOST_BYTES // 10**6} MB; cut the file or thin the recording")
    return (name, raw) if isinstance(raw, str) else (name, _unpacked(name, raw))


def is_workbook(raw: bytes) -> bool:
    """Whether the bytes are those of an Excel file, old or new."""
    if raw.startswith(COMPOUND):
        return True
    if not raw.startswith(ZIP):
        return False
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except zipfile.BadZipFile:
        return False


def _unpacked(name: str, raw: bytes) -> bytes:
    """The one file in a gzip or zip file; what is not packed as it is."""
    try:
        if raw.startswith(GZIP):
            with gzip.open(io.BytesIO(raw)) as packed:
                return _bounded(name, packed.read(MOST_BYTES + 1))
        if raw.startswith(ZIP) and not is_workbook(raw):
            with zipfile.ZipFile(io.BytesIO(raw)) as archive:
                return _bounded(name, archive.open(_only_table(name, archive)).read(MOST_BYTES + 1))
    except (zipfile.BadZipFile, EOFError, OSError, zlib.error, RuntimeError, NotImplementedError) as error:
        raise ValueError(f"{name}: cannot be unpacked ({error}); copy or export it again") from None
    return raw


def _bounded(name: str, raw: bytes) -> bytes:
    if len(raw) > MOST_BYTES:
        raise ValueError(f"{name}: unpacks to more than {MOST_BYTES // 10**6} MB")
    return raw


def _only_table(name: str, archive: zipfile.ZipFile) -> str:
    """The one table in a zip file; phones put what they know of themselves beside it, in folders of their own."""
    files = [entry.filename for entry in archive.infolist() if not entry.is_dir()]
    tables = [f for f in files if not f.startswith(("meta/", "__MACOSX/")) and os.path.basename(f)[:1] != "."]
    wanted = [f for f in tables if f.lower().endswith((".csv", ".txt", ".tsv", ".dat"))] or tables
    if len(wanted) != 1:
        held = ", ".join(wanted[:6]) or "none"
        raise ValueError(f"{name}: expected a zip file with one table in it, got {len(wanted)}: {held}; unpack it")
    return wanted[0]


def text(name: str, raw: bytes | str) -> tuple[str, tuple[str, ...]]:
    """The text of a file, whatever its encoding, and what is worth saying about it."""
    if isinstance(raw, str):
        return raw.removeprefix("\ufeff"), ()
    encoding = next((encoding for mark, encoding in MARKS if raw.startswith(mark)), None)
    if encoding is None and raw[:2000].count(b"\0") > 0.3 * len(raw[:2000]):
        encoding = "utf-16-le" if raw[1:2000:2].count(b"\0") >= raw[:2000:2].count(b"\0") else "utf-16-be"
    try:
        decoded = raw.decode(encoding or "utf-8")
    except UnicodeDecodeError:
        if encoding is not None:
            raise ValueError(f"{name}: not a text file, or a damaged one in {encoding}; save it as UTF-8") from None
        decoded = raw.decode("latin-1")
    _refuse_binary(name, decoded)
    return decoded, (f"The file is {encoding[:6].upper()}.",) if encoding and encoding != "utf-8-sig" else ()


def _refuse_binary(name: str, decoded: str) -> None:
    head = decoded[:1000]
    strange = sum(c < " " and c not in "\t\r\n\x0c" for c in head)
    if "\0" in decoded:
        line = decoded.count("\n", 0, decoded.index("\0")) + 1
        raise ValueError(f"{name}: line {line}: not a text file (a NUL byte); save it as comma-separated text (CSV)")
    if strange > 0.05 * len(head):
        raise ValueError(f"{name}: not a text file; save it as comma-separated text (CSV) in UTF-8")
