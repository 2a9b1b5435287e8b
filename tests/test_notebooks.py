"""The notebooks run from their first to their last cell, and the pictures in them are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient", reason="notebooks need nbclient: pip install '.[test]'")

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("examples/notebooks/*.ipynb"))


def pictures(notebook) -> list[int]:
    """Number of pictures that each cell shows."""
    outputs = [cell.get("outputs", []) for cell in notebook.cells]
    return [sum("image/png" in output.get("data", {}) for output in of_cell) for of_cell in outputs]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_its_pictures(path, tmp_path):
    kept = nbformat.read(path, as_version=4)
    run = nbclient.NotebookClient(
        nbformat.read(path, as_version=4), timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert pictures(run) == pictures(kept) and sum(pictures(kept)) > 0
