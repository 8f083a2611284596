"""Run the notebook of the tutorials, and save it with what its cells show.

    python docs/make_notebook.py

It runs in a temporary folder, in a few seconds. A test runs it as well, and compares the kinds of output.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parent / "tutorial" / "notebook.ipynb"
TIMEOUT_S = 200


def main() -> None:
    """Run the notebook and save it."""
    with tempfile.TemporaryDirectory() as folder:
        nbformat.write(executed(Path(folder)), NOTEBOOK)
    print(NOTEBOOK)


def executed(folder: Path) -> Any:
    """Return the notebook, run in a folder; an error in a cell is raised."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = NotebookClient(
        notebook, timeout=TIMEOUT_S, kernel_name="python3", resources={"metadata": {"path": str(folder)}}, record_timing=False
    )
    client.execute()
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return notebook


if __name__ == "__main__":
    main()
