"""Tables that other libraries read or hold: Excel workbooks, MATLAB files, pandas and polars frames."""

from __future__ import annotations

import datetime
import io
from typing import Any

import numpy as np

from jeuler.fitting.recordings.cells import shown
from jeuler.fitting.recordings.source import COMPOUND
from jeuler.fitting.recordings.table import Table, named
from jeuler.fitting.recordings.text import read_text


def is_frame(source: Any) -> bool:
    """Whether it is a pandas or polars frame."""
    return type(source).__module__.split(".")[0] in ("pandas", "polars") and hasattr(source, "columns")


def read_frame(frame: Any) -> Table:
    """The columns of a pandas or polars frame."""
    kind = type(frame).__module__.split(".")[0]
    source = f"the {kind} frame"
    names = [str(name) for name in frame.columns]
    if len(names) < 2 or not len(frame):
        raise ValueError(f"{source}: {len(frame)} rows of {len(names)} columns, expected a time and at least one value")
    columns: list[np.ndarray] = []
    text: set[int] = set()
    dates: set[int] = set()
    for k, name in enumerate(frame.columns):
        values, what = _frame_column(source, k, names[k], np.asarray(frame[name]))
        columns.append(values)
        if what:
            (text if what == "text" else dates).add(k)
    return Table(source, named(names), [""] * len(names), np.stack(columns, axis=1), frozenset(text), frozenset(dates))


def _frame_column(source: str, k: int, name: str, column: np.ndarray) -> tuple[np.ndarray, str]:
    """Numbers of a column, and whether it is "text" or "dates"."""
    if column.dtype.kind in "mM":
        first = column[~np.isnat(column)][:1]
        since = column - (first[0] if len(first) and column.dtype.kind == "M" else np.timedelta64(0, "ns"))
        seconds = since / np.timedelta64(1, "s")
        return np.where(np.isnat(column), np.nan, seconds), "dates"
    if column.dtype.kind in "biuf":
        values = column.astype(float)
    else:
        values = np.array([_cell_number(cell) for cell in column])
        filled = [cell for cell in column if cell is not None and cell == cell]
        if filled and np.isnan(values).all():
            return values, "text"
        bad = np.flatnonzero(np.isnan(values) & np.array([isinstance(cell, str) and bool(cell) for cell in column]))
        if bad.size:
            cell = shown(str(column[bad[0]]))
            raise ValueError(f"{source}: row {bad[0] + 1}: column {k + 1} ({name}): expected a number, got {cell}")
    if np.isinf(values).any():
        row = int(np.flatnonzero(np.isinf(values))[0])
        raise ValueError(f"{source}: row {row + 1}: column {k + 1} ({name}): expected a number, got {values[row]}")
    return values, ""


def _cell_number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return float("nan")


def read_workbook(source: str, raw: bytes, skip: int = 0) -> Table:
    """The first sheet of a workbook that holds a table, by pandas with openpyxl (.xlsx) or by xlrd (.xls)."""
    old = raw.startswith(COMPOUND)
    try:
        sheets = _old_sheets(raw) if old else _new_sheets(raw)
    except ImportError:
        needed = "xlrd" if old else "pandas and openpyxl"
        raise ValueError(
            f"{source}: an Excel workbook needs {needed}: pip install 'jeuler[io]', or save it as CSV"
        ) from None
    except Exception as error:  # what the readers raise for a damaged workbook is documented by none
        raise ValueError(
            f"{source}: the workbook cannot be read ({error or type(error).__name__}); save the sheet as CSV"
        ) from None
    refusals = []
    for name, rows in sheets.items():
        width = max(map(len, rows), default=0)
        if len(rows) < 2 or width < 2:
            refusals.append(f"{source}: sheet {name!r}: {len(rows)} rows of {width} columns")
            continue
        lines = ["\t".join(_cell_text(cell) for cell in row) for row in rows]
        note = (f"The sheet {name!r} of {len(sheets)} was read.",) if len(sheets) > 1 else ()
        try:
            return read_text(f"{source}: sheet {name!r}", "\n".join(lines), skip, note)
        except ValueError as error:
            refusals.append(str(error))
    raise ValueError(refusals[0] if refusals else f"{source}: the workbook has no sheet")


def _new_sheets(raw: bytes) -> dict[str, list[Any]]:
    """The cells of each sheet of an .xlsx file, row by row."""
    import pandas

    sheets = pandas.read_excel(io.BytesIO(raw), sheet_name=None, header=None, engine="openpyxl", dtype=object)
    return {str(name): list(sheet.itertuples(index=False)) for name, sheet in sheets.items()}


def _old_sheets(raw: bytes) -> dict[str, list[Any]]:
    """The cells of each sheet of an .xls file, row by row; spreadsheet errors are missing values."""
    import xlrd

    book = xlrd.open_workbook(file_contents=raw, logfile=io.StringIO())

    def value(cell: Any) -> Any:
        if cell.ctype == xlrd.XL_CELL_DATE:
            return xlrd.xldate_as_datetime(cell.value, book.datemode)
        return None if cell.ctype == xlrd.XL_CELL_ERROR else cell.value

    return {sheet.name: [[value(cell) for cell in row] for row in sheet.get_rows()] for sheet in book.sheets()}


def _cell_text(cell: Any) -> str:
    if cell is None or cell != cell:
        return ""
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, bool):
        return str(int(cell))
    return " ".join(str(cell).split())


def read_matlab(source: str, raw: bytes) -> Table:
    """The numeric vectors and matrices of a MATLAB file (version 5 to 7.2) that have as many rows as the longest."""
    from scipy.io import loadmat

    try:
        held = loadmat(io.BytesIO(raw), squeeze_me=True)
    except Exception as error:  # loadmat raises whatever a damaged file leads it to
        raise ValueError(f"{source}: the MATLAB file cannot be read ({error}); save it as CSV") from None
    arrays = {
        name: np.asarray(value, float)
        for name, value in held.items()
        if not name.startswith("__") and isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
    rows = max((len(value) for value in arrays.values() if value.ndim in (1, 2)), default=0)
    names: list[str] = []
    columns: list[np.ndarray] = []
    for name, value in arrays.items():
        if value.ndim == 1 and len(value) == rows:
            names, columns = [*names, name], [*columns, value]
        elif value.ndim == 2 and len(value) == rows:
            names += [f"{name}_{k + 1}" for k in range(value.shape[1])]
            columns += list(value.T)
    if len(columns) < 2:
        raise ValueError(f"{source}: {len(columns)} numeric columns of {rows} rows, expected a time and a value")
    return Table(source, named(names), [""] * len(names), np.stack(columns, axis=1))
