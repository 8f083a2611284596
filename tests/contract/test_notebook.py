"""Run the notebook of the tutorials in a kernel, without ipywidgets, and compare what its cells show with what is saved."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


def outputs(notebook: Any) -> list[list[tuple[str, ...]]]:
    """Return what each cell shows: the kinds of its outputs, with their formats."""
    return [
        [(output.output_type, *sorted(output.get("data", {})), output.get("name", "")) for output in cell.outputs]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


@pytest.fixture(scope="module")
def make_notebook() -> Any:
    """The script that runs the notebook and saves it."""
    for name in ("nbformat", "nbclient", "ipykernel"):
        pytest.importorskip(name, reason="the notebook needs photonpano[dev]")
    spec = importlib.util.spec_from_file_location("make_notebook", ROOT / "docs" / "make_notebook.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def executed(make_notebook: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Path]:
    """The notebook as it is saved, as it has run, and the folder where it ran."""
    import nbformat

    folder, patch = tmp_path_factory.mktemp("notebook"), pytest.MonkeyPatch()
    (folder / "ipywidgets.py").write_text("raise ImportError('ipywidgets is not installed')\n")
    with patch.context() as patched:
        patched.setenv("IPYTHONDIR", str(folder / ".ipython"))
        return nbformat.read(make_notebook.NOTEBOOK, as_version=4), make_notebook.executed(folder), folder


# ipykernel itself warns of its transport, and of event loops
pytestmark = [pytest.mark.documentation, pytest.mark.filterwarnings("ignore")]


def test_cells_show_what_is_saved(executed: tuple[Any, Any, Path]) -> None:
    saved, run, _ = executed
    assert outputs(run) == outputs(saved)
    shown = [kind for cell in outputs(run) for kind in cell]
    assert not [each for each in shown if each[0] == "error" or each[-1] == "stderr"]
    assert len([each for each in shown if each[0] == "display_data"]) == 2  # one for the bars of a cell


def test_saved_notebook_does_not_tell_where_it_ran(executed: tuple[Any, Any, Path], make_notebook: Any) -> None:
    saved, run, folder = executed
    nbformat = pytest.importorskip("nbformat")
    assert str(folder) in nbformat.writes(run)
    assert str(folder) not in make_notebook.saved(run, folder)
    assert "/tmp/" not in nbformat.writes(saved)


def test_bars_are_full_and_results_are_pictures(executed: tuple[Any, Any, Path]) -> None:
    _, run, folder = executed
    html = [
        output.data["text/html"]
        for cell in run.cells
        for output in cell.get("outputs", ())
        if "data" in output and "text/html" in output.data
    ]
    bars = [each for each in html if "<progress" in each]
    assert len(bars) == 2
    assert 'value="800" max="800"' in bars[0]
    assert "level 2: merge and locate" in bars[1]
    assert len([each for each in html if "data:image/png;base64," in each]) == 2
    assert len([each for each in html if "<polyline" in each]) == 1
    assert (folder / "runs" / "notebook" / "report.html").exists()
