"""Values and progress as HTML."""

import base64
import io
import re
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from photonpano import (
    BatchResult,
    BatchRow,
    Quiet,
    capture_plan,
    info,
    load_panorama,
    load_trajectory,
)
from photonpano.execution.context import usual
from photonpano.notebooks import NotebookBars, in_notebook


def pixels_of(html: str) -> np.ndarray:
    data = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert data is not None
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data[1]))))


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a cell of a notebook shows, one item for each time it is drawn."""
    shown: list[str] = []

    class Handle:
        def update(self, value: Any) -> None:
            shown.append(value._repr_html_())

    def display(value: Any, *, display_id: bool) -> Handle:
        assert display_id
        shown.append(value._repr_html_())
        return Handle()

    modules = {
        "ipykernel": {},
        "IPython": {},
        "IPython.core": {},
        "IPython.core.getipython": {"get_ipython": lambda: types.SimpleNamespace(kernel=object())},
        "IPython.display": {"display": display},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return shown


def test_progress_is_bars_in_notebook_and_nothing_elsewhere(cell: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    given = Quiet()
    assert in_notebook()
    assert isinstance(usual(None), NotebookBars)
    assert usual(given) is given
    monkeypatch.delitem(sys.modules, "ipykernel")
    assert isinstance(usual(None), Quiet)
    assert cell == []


def test_bars_are_one_output_that_ends_with_what_was_done(cell: list[str]) -> None:
    bars = NotebookBars()
    with bars.stage("level 1: <locate>", 1000, "exposures") as advance:
        for _ in range(1000):
            advance(1)
    bars.note("level 1: 3 < 4")
    assert len(cell) < 10  # not once a unit
    assert 'value="0" max="1000"' in cell[0]
    assert 'value="1000" max="1000"' in cell[-1]
    assert "level 1: &lt;locate&gt;" in cell[-1]
    assert "level 1: 3 &lt; 4" in cell[-1]


def test_run_shows_picture_verdict_and_folder(small_run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small_run.directory.parent)
    html = small_run._repr_html_()
    assert pixels_of(html).shape[:2] == (small_run.record["panorama"]["height"], small_run.record["panorama"]["width"])
    assert small_run.record["verdict"]["status"] in html
    assert f">{small_run.directory.name}<" in html
    assert len(repr(small_run)) < 1000


def test_viewer_of_a_run_is_its_report_in_a_frame(small_run: Any, tmp_path: Path, browser_page: Any) -> None:
    (page := tmp_path / "cell.html").write_text(small_run.viewer(700)._repr_html_())
    browser_page.open(page)
    browser_page.wait_for('document.querySelector("iframe").contentDocument.querySelector("#viewer.live")')
    assert browser_page.run('document.querySelector("iframe").clientHeight') == 700
    assert (browser_page.messages, browser_page.requests) == ([], [])


def test_panorama_and_trajectory_of_run_show_themselves(small_run: Any) -> None:
    panorama = load_panorama(small_run.directory)
    assert pixels_of(panorama._repr_html_()).shape == panorama.flux.shape
    trajectory = load_trajectory(small_run.directory)
    html = trajectory._repr_html_()
    assert f"{trajectory.located.sum()} of {len(trajectory.located)} located" in html
    assert len(re.findall(r"[-\d.]+,[-\d.]+", html[html.index("<polyline") :])) == min(500, trajectory.located.sum())


def test_capture_shows_itself(small_capture: Path) -> None:
    found = info(capture_plan(small_capture, {"frame_rate_hz": 96_800}))
    html = found._repr_html_()
    assert all(name in html for name, _ in found.rows())
    assert "photons per pixel per frame" in html


def test_batch_shows_its_runs_and_its_summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = BatchRow("a <b>", Path("a.npy"), {"levels": 1}, tmp_path / "monday" / "a", "done", verdict="trusted", n_frames=2000)
    failed = BatchRow("c", Path("c.npy"), {"levels": 1}, tmp_path / "monday" / "c", "failed", reason="too dark\nfor this")
    html = BatchResult(tmp_path / "monday", (done, failed), ("levels",))._repr_html_()
    assert [re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", row) for row in html.split("<tr>")[1:]] == [
        list(BatchRow.COLUMNS),
        ["a &lt;b&gt;, levels=1", "trusted", *3 * ["\N{EN DASH}"], "2,000", "\N{EN DASH}", "\N{EN DASH}", ""],
        ["c, levels=1", "failed", *6 * ["\N{EN DASH}"], "too dark\nfor this"],
        ["summary", str(Path("monday", "summary.html"))],
    ]
