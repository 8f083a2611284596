"""The captures, the settings and the summary of a batch."""

import csv
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import BatchRow, InputError, SpecError, discover
from photonpano.api.batch import Batch, prepare_batch
from photonpano.api.batch_jobs import find_captures, folder_name
from photonpano.api.batch_running import write_summary

Find = Callable[..., dict[str, Path]]


@pytest.fixture
def find(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Find:
    """Find captures from a folder in which there are some; a folder with a file `is-capture` in it is one."""
    monkeypatch.chdir(tmp_path)
    for name in (
        "day/b.npy",
        "day/a.npy",
        "day/a.truth.npz",
        "day/notes.txt",
        "night/c.npy",
        "bins/is-capture",
        "bins/0.bin",
        "run/run.json",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "empty").mkdir()

    def find(*given: str | Path, lists: tuple[str, ...] = ()) -> dict[str, Path]:
        return find_captures(given, lists, discover(), lambda path: (path / "is-capture").exists())

    return find


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["day/a.npy", "night/c.npy"], {"a": "day/a.npy", "c": "night/c.npy"}),
        (["[br][iu]n*"], {"bins": "bins"}),
        (["day/*.np?"], {"a": "day/a.npy", "b": "day/b.npy"}),
        (["**/*.npy"], {"a": "day/a.npy", "b": "day/b.npy", "c": "night/c.npy"}),
        (["day"], {"a": "day/a.npy", "b": "day/b.npy"}),
        (["bins"], {"bins": "bins"}),
        (["."], {"bins": "bins"}),
        (["night/c.npy", "day/../night/c.npy", "night/*"], {"c": "night/c.npy"}),
        (["absent.npy"], {"absent": "absent.npy"}),
        (["day/b.npy", "old/b.c.npy.gz"], {"b": "day/b.npy", "b.c": "old/b.c.npy.gz"}),
        (["s3://day/b.npy", "s3://day/b.npy", "s3://night"], {"b": "s3://day/b.npy", "night": "s3://night"}),
        (["https://me:secret@host/c.npy.gz?key=secret"], {"c": "https://host/c.npy.gz"}),
    ],
    ids=lambda value: " ".join(value),
)
def test_captures_are_named_after_their_files(find: Find, given: list[str], named: dict[str, str]) -> None:
    assert {name: str(path) for name, path in find(*given).items()} == named
    assert list(find(*given)) == list(named)


def test_all_problems_come_at_once(find: Find) -> None:
    Path("bad.txt").write_text("day/a.npy\nday/*.h5\n", encoding="utf-8")
    Path("none.txt").write_text("# nothing\n", encoding="utf-8")
    Path("data.txt").write_bytes(b"\x93NUMPY\0")
    Path("latin.txt").write_bytes("n\xe4chtlich.npy".encode("latin-1"))
    Path("night/a.npy").touch()
    with pytest.raises(InputError) as caught:
        find(
            *("*.mat", "empty", "night", "a\0b", "caf\udce9", "s3://day/*.npy"),
            lists=("bad.txt", "none.txt", "data.txt", "latin.txt", "absent.txt"),
        )
    assert str(caught.value).splitlines() == [
        "nothing matches *.mat; check the pattern",
        "empty is no capture that the spec can read, and there is none in it; name the files",
        "'a\\x00b' contains the character NUL, which no path can; correct the path",
        "s3://day/*.npy is a pattern, and only files of this computer are matched; name each URL, as in a list",
        "bad.txt:2: nothing matches day/*.h5; check the pattern",
        "none.txt: the list names no capture; write one a line",
        "data.txt: not a list of captures, which is text; name captures as arguments",
        "latin.txt: the list is not UTF-8 text; save it as UTF-8, one capture a line",
        "absent.txt: the list of captures cannot be read: No such file or directory",
        "'caf\\udce9' is no text of UTF-8, which results cannot record; rename it",
        "two captures are called a, and would get one run folder: night/a.npy and day/a.npy; rename one of them, "
        "or run them in two batches",
    ]
    with pytest.raises(InputError, match="no capture is given: name files, folders, or patterns in quotes"):
        find()


SPEC = {"version": 1, "source": {"use": "auto"}, "resample": {"with": {"group_size": 25}}}


@pytest.fixture
def prepare(tmp_path: Path) -> Callable[..., Batch]:
    """Prepare a batch of one capture that is missing, and one that is there."""
    np.save(tmp_path / "cube.npy", np.zeros((200, 64, 12), np.uint8))

    def prepare(spec: dict[str, Any] = SPEC, **options: Any) -> Batch:
        return prepare_batch(spec, [tmp_path / "absent.npy", tmp_path / "cube.npy"], tmp_path / "out", **options)

    return prepare


def problems(caught: pytest.ExceptionInfo[SpecError]) -> list[str]:
    return [str(each) for each in caught.value.problems]


def test_every_combination_has_a_folder_of_its_own(prepare: Callable[..., Batch], tmp_path: Path) -> None:
    batch = prepare(changes=["run.seed=1", "resample.with.group_size=[20, 25]"], swept=["levels=1,2", "run.memory=2 GiB"])
    assert batch.common == ("run.seed=1",)
    assert batch.keys == ("resample.with.group_size", "levels", "run.memory")
    folders = [row.directory.relative_to(tmp_path / "out").as_posix() for row in batch.rows]
    assert len({*folders}) == 8
    assert re.fullmatch(r"absent,resample\.with\.group_size=20,levels=1,run\.memory=2_GiB-[0-9a-f]{8}", folders[0])
    assert [dict(row.settings) for row in batch.rows[:2]] == [
        {"resample.with.group_size": 20, "levels": 1, "run.memory": "2 GiB"},
        {"resample.with.group_size": 20, "levels": 2, "run.memory": "2 GiB"},
    ]


def test_all_problems_come_before_anything_runs(prepare: Callable[..., Batch]) -> None:
    with pytest.raises(SpecError) as caught:
        prepare(changes=["run.sed=1"], swept=["resample.with.gruop_size=20,25", "levels=2,9", "run.seed=0,-1"])
    assert problems(caught) == [
        "resample.with.gruop_size: unknown key; did you mean 'group_size'? (in the override resample.with.gruop_size=20)",
        "run.sed: unknown key; did you mean 'seed'? (in the override run.sed=1)",
        "run.seed: expected an integer of at least 0, got -1 (in the override run.seed=-1)",
        "levels: expected an integer from 1 to 8, until-converged, or a list with an entry for each level, got 9 "
        "(in the override levels=9)",
    ]


@pytest.mark.parametrize(
    ("changes", "swept", "message"),
    [
        ([], ["run.seed"], "expected KEY=VALUE, such as run.seed=1 (in the override run.seed)"),
        (
            [],
            ["run.seed="],
            "run.seed: expected values with commas between them, such as 50,100,200 (in the override run.seed=)",
        ),
        (
            [],
            ["run.seed=1,2", "run.seed=3"],
            "run.seed: is swept twice; give all of its values at once (in the override run.seed=3)",
        ),
        ([], ["run.seed={1"], "run.seed: not valid YAML"),
        (["source.with.path=a.npy"], [], "source.with.path: the captures of a batch are given beside the spec"),
        ([], ["output.directory=a,b"], "output.directory: the folder of a batch is --output"),
    ],
)
def test_wrong_settings_are_refused(prepare: Callable[..., Batch], changes: list[str], swept: list[str], message: str) -> None:
    with pytest.raises(SpecError) as caught:
        prepare(changes=changes, swept=swept)
    [problem] = problems(caught)
    assert problem.startswith(message)


def test_names_of_folders_are_safe_and_differ() -> None:
    names = [folder_name("cube", {"merge.with.file": value}) for value in ("a b", "a/b", "x" * 300, "x" * 301)]
    assert len({*names}) == 4
    assert all("/" not in name and " " not in name and len(name) < 200 for name in names)
    assert folder_name("cube", {"run.seed": 1, "levels.0.scale": 0.5}) == "cube,run.seed=1,levels.0.scale=0.5"
    assert folder_name("a b", {}) == "a b"


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
    assert "<script" not in page
    links = set(re.findall(r'(?:src|href|url\()="?([^")\s]+)', page))
    assert links == {PICTURE, "good/report.html", "odd%20%231/report.html", "dark.failed.html"}, "no other file is needed"
    assert "<code>run.seed=1</code>" in page


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


def test_runs_of_a_capture_are_ranked_by_how_well_they_explain_the_photons(tmp_path: Path) -> None:
    found = {50: ("doubtful", 0.9), 25: ("trusted", 1.2), 100: ("trusted", 1.1), 200: (None, None)}
    rows = [
        row(name, tmp_path, {"size": size}, **DONE | {"verdict": verdict, "reduced_chi2": chi2, "expected_error_px": 1 / size})
        for name in ("b", "a")
        for size, (verdict, chi2) in found.items()
    ]
    table, page = summary(tmp_path, rows, ("size",))
    assert [(each["name"], each["size"]) for each in table] == [
        (name, size) for name in "ba" for size in ("100", "25", "50", "200")
    ]
    assert "ranked: trusted before doubtful, then by chi-square" in page
