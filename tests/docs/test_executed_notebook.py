"""The notebook of the documentation shows what its cells show today."""

from __future__ import annotations

import pytest
from run_notebook import NOTEBOOK, executed, shown

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("ipykernel", reason="nbclient starts it")


@pytest.mark.slow
def test_the_notebook_shows_what_its_cells_show():
    written = shown(nbformat.read(NOTEBOOK, as_version=4))
    assert shown(executed()) == written, "run `python tools/run_notebook.py --write`"
