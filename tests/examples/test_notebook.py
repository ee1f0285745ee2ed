"""The notebook runs as a reader would run it."""

from __future__ import annotations

import re

import pytest

from tests.contract.tree import ROOT

NOTEBOOK = ROOT / "docs" / "tutorials" / "from-pcap-to-odometry.ipynb"


def test_the_notebook_finds_the_path() -> None:
    needed = ("nbformat", "nbclient", "ipykernel", "kiss_icp", "matplotlib")
    nbformat, nbclient, *_ = map(pytest.importorskip, needed)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(
        notebook, timeout=None, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}
    ).execute()
    printed = "".join(
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and output.name == "stdout"
    )
    found = re.search(r"(\d\.\d+) m from the start, off by (\d\.\d+) m at most", printed)
    assert found, printed
    # By moving.truth.tum, from the end of the first window to that of the last.
    assert float(found[1]) == pytest.approx(1.51, abs=0.01)
    # A tenth of the way.
    assert float(found[2]) < 0.15
