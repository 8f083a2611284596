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
HOME = "/home/you"


def main() -> None:
    """Run the notebook and save it."""
    with tempfile.TemporaryDirectory() as folder:
        NOTEBOOK.write_text(saved(executed(Path(folder)), Path(folder)), encoding="utf-8")
    print(NOTEBOOK)


def saved(notebook: Any, folder: Path) -> str:
    """Return the text of a notebook that has run, as if it had done so in `HOME`: where it ran tells nothing."""
    return f"{nbformat.writes(notebook).replace(str(folder), HOME)}\n"


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
