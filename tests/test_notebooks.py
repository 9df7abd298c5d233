"""Every notebook runs from top to bottom; an error in a cell fails."""

import os
import pathlib

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((pathlib.Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.optimised
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel shows figures with a backend of its own
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    if folder := os.environ.get("JEULER_EXECUTED_NOTEBOOKS"):  # for the site, which then need not run them again
        pathlib.Path(folder).mkdir(exist_ok=True)
        nbformat.write(notebook, pathlib.Path(folder, path.name))
    assert any(cell.cell_type == "code" and cell.outputs for cell in notebook.cells)
