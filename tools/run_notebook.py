"""The notebook of the documentation, which `tools/make_pictures.py` executes."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import nbformat

NOTEBOOK = Path(__file__).resolve().parent.parent / "docs" / "tutorials" / "notebook.ipynb"
PICTURE = re.compile(r"base64,[\w+/=]+")


def executed(path: Path = NOTEBOOK) -> Any:
    """Return the notebook with the outputs of its cells; it runs in a temporary folder.

    Args:
        path: the notebook.
    """
    from nbclient import NotebookClient

    notebook = written(path)
    with tempfile.TemporaryDirectory() as folder:
        place: dict[str, Any] = {"metadata": {"path": folder}}
        NotebookClient(notebook, resources=place, record_timing=False).execute()
    return notebook


def write(notebook: Any, path: Path) -> None:
    """Write a notebook with the outputs of its cells.

    Args:
        notebook: the notebook.
        path: its file.
    """
    nbformat.write(notebook, path)


def written(path: Path) -> Any:
    """Return the notebook of a file.

    Args:
        path: the file.
    """
    return nbformat.read(path, as_version=4)


def shown(notebook: Any) -> str:
    """Return the texts that the cells show, without their pictures.

    Args:
        notebook: an executed notebook.
    """
    texts = []
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            texts += [output.get("text"), data.get("text/plain")]
            html = data.get("text/html", "")
            if html.startswith("<pre>"):  # of this package: that of pandas changes with its version
                texts.append(PICTURE.sub("", html))
    return "\n".join(filter(None, texts))
