from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from photonpano import BatchRow, OutputError
from photonpano.api.batching.summary import require_own, write_summary

PICTURE = "data:image/jpeg;base64,/9j/"
DONE = {
    "status": "done",
    "verdict": "trusted",
    "expected_error_px": 0.1,
    "true_error_px": 0.05,
    "psnr_db": 26.5,
    "n_frames": 2000,
    "seconds": 1.5,
    "peak_memory_bytes": 2**28,
    "thumbnail": PICTURE,
}


def row(name: str, folder: Path, settings: dict[str, Any] | None = None, **found: Any) -> BatchRow:
    report = folder / name / "report.html" if found.get("status") == "done" else None
    return BatchRow(name, Path(f"captures/{name}.npy"), settings or {}, folder / name, **{"report": report} | found)


def summary(folder: Path, rows: list[BatchRow], keys: tuple[str, ...] = ()) -> tuple[list[dict[str, str]], str]:
    write_summary(folder, rows, "version: 1\n", ["run.seed=1"], keys)
    with (folder / "summary.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    return table, (folder / "summary.html").read_text(encoding="utf-8")


def test_every_status_is_a_row(tmp_path: Path) -> None:
    rows = [
        row("good", tmp_path, **DONE),
        row("odd #1", tmp_path, **DONE | {"verdict": "doubtful", "reason": "frames are blurred\nwarning: hot"}),
        row("bad", tmp_path, status="failed", reason='a "<b>" is cut short,\ncopy it again'),
        row("dark", tmp_path, status="failed", reason="no pair", report=tmp_path / "dark.failed.html"),
        row("now", tmp_path, status="running"),
        row("next", tmp_path),
        row("never", tmp_path, status="interrupted"),
    ]
    table, page = summary(tmp_path, rows)
    assert [(each["name"], each["status"], each["verdict"]) for each in table] == [
        ("good", "done", "trusted"),
        ("odd #1", "done", "doubtful"),
        ("bad", "failed", ""),
        ("dark", "failed", ""),
        ("now", "running", ""),
        ("next", "waiting", ""),
        ("never", "interrupted", ""),
    ]
    assert table[0] | {"run": "good", "true_error_px": "0.05", "peak_memory_bytes": str(2**28)} == table[0]
    assert table[2]["reason"] == 'a "<b>" is cut short,\ncopy it again'
    statuses = re.findall(r'class="status \w*">([^<]+)<', page)
    assert statuses == ["1 trusted", "1 doubtful", "2 failed", "1 running", "1 waiting", "1 interrupted"]
    assert "a &#34;&lt;b&gt;&#34; is cut short,<br/>copy it again" in page
    assert 'href="odd%20%231/report.html"' in page
    assert page.count('<a href="dark.failed.html">dark</a>') == 2
    assert page.count('<th scope="row">bad</th>') == 2
    assert page.count(PICTURE) == 2
    assert "<code>run.seed=1</code>" in page


def test_page_needs_no_other_file(tmp_path: Path) -> None:
    page = summary(tmp_path, [row("good", tmp_path, **DONE)])[1]
    links = re.findall(r'(?:src|href|url\()="?([^")\s]+)', page)
    assert links == ["good/report.html", PICTURE, "good/report.html"]
    assert "<script" not in page


def test_poses_have_errors_of_positions(tmp_path: Path) -> None:
    found = {"expected_error_px": None, "true_error_px": None, "psnr_db": None, "thumbnail": None}
    rows = [row("room", tmp_path, **DONE | found | {"expected_position_error": 0.0123, "true_position_error": 0.02})]
    table, page = summary(tmp_path, rows)
    assert (table[0]["expected_position_error"], table[0]["expected_error_px"]) == ("0.0123", "")
    assert "1.23 %" in page
    assert "PSNR" not in page
    assert "in per cent of the length of the path" in page


@pytest.mark.parametrize(("n_captures", "thin", "legend"), [(2, 0, ["scan-0", "scan-1"]), (6, 2 * 6, ["median"])])
def test_sweep_is_drawn_over_its_values(tmp_path: Path, n_captures: int, thin: int, legend: list[str]) -> None:
    key = "resample.with.group_size"
    rows = [
        row(f"scan-{number}", tmp_path, {key: size}, **DONE | {"true_error_px": size / 100})
        for number in range(n_captures)
        for size in (50, 25)
    ]
    rows.append(replace(rows[0], status="failed", true_error_px=None, expected_error_px=None, reason="x"))
    table, page = summary(tmp_path, rows, (key,))
    assert [each[key] for each in table[:2]] == ["50", "25"]
    figure = re.search(r"<svg.*?</svg>", page, re.DOTALL)[0]
    assert figure.count("stroke: var(--muted); stroke-opacity: 0.5") == thin
    assert [name for name in ("scan-0", "scan-1", "median") if f">{name}</text>" in figure] == legend
    assert "true error (px)" in figure


def test_values_that_are_no_numbers_are_named(tmp_path: Path) -> None:
    key = "locate.use"
    rows = [row("scan", tmp_path, {key: name}, **DONE) for name in ("direct", "opencv-sift")]
    page = summary(tmp_path, rows, (key,))[1]
    assert ">direct</text>" in page
    assert ">opencv-sift</text>" in page


def test_sweep_without_any_result_has_no_figure(tmp_path: Path) -> None:
    assert "<svg" not in summary(tmp_path, [row("scan", tmp_path, {"run.seed": 1})], ("run.seed",))[1]


def test_summary_of_something_else_is_not_replaced(tmp_path: Path) -> None:
    require_own(tmp_path)
    summary(tmp_path, [row("good", tmp_path, **DONE)])
    require_own(tmp_path)
    (tmp_path / "summary.csv").write_text("month,sum\n", encoding="utf-8")
    with pytest.raises(OutputError, match=r"summary\.csv is no summary of a batch, and would be replaced"):
        require_own(tmp_path)


def test_name_that_is_not_unicode_is_written(tmp_path: Path) -> None:
    table, page = summary(tmp_path, [row("caf\udce9", tmp_path, **DONE)])
    assert table[0]["name"] == "caf\\udce9"
    assert "caf\\udce9" in page
