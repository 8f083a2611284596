from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.api.batching.sweeps import Job

DASH = "\N{EN DASH}"
SPEC = "version: 1\nsource: {use: auto}\nresample: {with: {group_size: 25}}\n"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a spec and two captures: a run of `bad` fails, one of `odd` is doubtful, and others are trusted."""
    monkeypatch.chdir(tmp_path)
    Path("scan.yaml").write_text(SPEC, encoding="utf-8")
    for name in ("good", "odd"):
        np.save(f"{name}.npy", np.zeros((200, 64, 12), np.uint8))

    def rows_of(jobs: Sequence[Job], n_workers: int) -> Any:
        for index, job in enumerate(jobs):
            yield [(index, replace(job.row, status="running"))]
            assert Path("out/summary.csv").read_text().count(",running,") == 1
            verdict = "doubtful" if job.row.name == "odd" else "trusted"
            done = replace(job.row, status="done", verdict=verdict, n_frames=200, expected_error_px=0.123, seconds=n_workers)
            failed = replace(job.row, status="failed", reason="cut short\ncopy it again")
            yield [(index, failed if job.row.name == "bad" else done)]

    monkeypatch.setattr("photonpano.api.batch.rows_of", rows_of)
    return tmp_path


def test_batch_prints_a_line_and_a_row_for_each_run(place: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("batch", "scan.yaml", "good.npy", "odd.npy", "-o", "out")
    assert done.exit_code == 0
    assert done.stderr == "[1/2] good: trusted, expected error 0.12 px\n[2/2] odd: doubtful, expected error 0.12 px\n"
    assert done.stdout.replace(DASH, "-") == (
        "capture  verdict   expected error  true error  frames  time  memory  reason\n"
        "good     trusted   0.12 px         -           200     1 s   -\n"
        "odd      doubtful  0.12 px         -           200     1 s   -\n"
        f"\nsummary   {place}/out/summary.html\n"
    )


def test_failed_run_exits_with_1(place: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("batch", "scan.yaml", "bad.npy", "good.npy", "-o", "out", "--jobs", "9", "--strict")
    assert done.exit_code == 1
    assert (
        "\nbad      failed   -               -           -       -     -       cut short\ngood     trusted"
        in done.stdout.replace(DASH, "-")
    )
    assert "200     2 s" in done.stdout
    assert done.stderr.splitlines() == [
        "[1/2] bad: failed: cut short",
        "[2/2] good: trusted, expected error 0.12 px",
        "error: 1 of 2 runs failed; the others are done",
    ]


def test_nothing_else_is_done_where_all_fail(place: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("batch", "scan.yaml", "bad.npy", "-o", "out")
    assert done.stderr.endswith("error: 1 of 1 run failed\n")


def test_doubtful_run_fails_with_strict_alone(place: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("batch", "scan.yaml", "odd.npy", "-o", "out", "--strict")
    assert done.exit_code == 1
    assert "error: 1 run is doubtful, and --strict accepts only trusted ones" in done.stderr


def test_sweep_has_a_row_for_each_value(place: Path, invoke: Callable[..., Any]) -> None:
    Path("list.txt").write_text("good.npy\n", encoding="utf-8")
    done = invoke(*("batch", "scan.yaml", "--from", "list.txt", "-o", "out", "--sweep", "levels=1,2", "--set", "run.seed=[3]"))
    assert [line.partition("  ")[0] for line in done.stdout.splitlines()[1:3]] == [
        "good, run.seed=3, levels=1",
        "good, run.seed=3, levels=2",
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "error: no capture is given: name files, folders, or patterns in quotes such as 'captures/*.npy'"),
        (["*.h5"], "error: nothing matches *.h5; check the pattern"),
        (["--from", "absent.txt"], "error: absent.txt: the list of captures cannot be read: No such file or directory"),
        (
            ["good.npy", "old/good.npy"],
            "error: two captures are called good, and would get one run folder: good.npy and old/good",
        ),
        (["good.npy", "--sweep", "levls=1,2"], "levls: unknown key; did you mean 'levels'? (in the override levls=1)"),
        (["good.npy", "--jobs", "0"], "Invalid value for '--jobs'"),
    ],
)
def test_wrong_command_line_exits_with_2_before_anything_is_written(
    place: Path, invoke: Callable[..., Any], arguments: list[str], message: str
) -> None:
    done = invoke("batch", "scan.yaml", *arguments, "-o", "out")
    assert (done.exit_code, done.stdout) == (2, "")
    assert message in done.stderr
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Path("out").touch(), "/out cannot be the folder of a batch: File exists; choose another one with --output"),
        (lambda: Path("out").symlink_to("out"), "/out cannot be the folder of a batch: "),
        (lambda: (Path("out").mkdir(), Path("out/summary.csv").touch()), "/out/summary.csv is no summary of a batch"),
    ],
    ids=["file", "loop", "other summary"],
)
def test_folder_that_cannot_be_written_fails(
    place: Path, invoke: Callable[..., Any], make: Callable[[], object], message: str
) -> None:
    make()
    done = invoke("batch", "scan.yaml", "good.npy", "-o", "out")
    assert done.exit_code == 1
    assert done.stderr.startswith(f"error: {place}{message}")
