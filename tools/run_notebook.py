"""Execute the notebook of the documentation.

    python tools/run_notebook.py --write    write the outputs of today's tool into the notebook

A test executes it as well, and compares what its cells show with what the file shows.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).resolve().parent.parent / "docs" / "tutorials" / "notebook.ipynb"
PICTURE = re.compile(r"base64,[\w+/=]+")


def executed(path: Path = NOTEBOOK) -> Any:
    """Return the notebook with the outputs of its cells; it runs in a temporary folder.

    Args:
        path: the notebook.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        place: dict[str, Any] = {"metadata": {"path": folder}}
        NotebookClient(notebook, resources=place, record_timing=False).execute()
    return notebook


def shown(notebook: Any) -> list[str]:
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
    return texts


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit("say --write to write the outputs of its cells into the notebook")
    import nbformat as nbf

    nbf.write(executed(), NOTEBOOK)
