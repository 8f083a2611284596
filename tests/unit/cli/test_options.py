"""Captures named on the command line: options, and errors that name them."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from photonpano.api.command import WrongArgumentError
from photonpano.cli.plans import capture_plan
from photonpano.errors import SpecError


@pytest.fixture
def cube(folder: Path) -> Path:
    np.save(folder / "cube.npy", np.zeros((20, 8, 2), np.uint8))
    return folder / "cube.npy"


def test_capture_plan_resolves_path_from_current_folder(cube: Path) -> None:
    with capture_plan(Path("cube.npy")) as plan:
        pass
    assert (plan.source.contribution.name, plan.source.config.path) == ("packed-npy", cube)


def test_capture_plan_reads_option_values_as_yaml(cube: Path) -> None:
    corrections = ["rot90", "{crop: {rows: [2, null]}}"]
    with capture_plan(Path("cube.npy"), "packed-npy", ["frame_rate_hz=1e3", "width=13"], corrections) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width) == (1000, 13)
    assert plan.document["corrections"] == ["rot90", {"crop": {"rows": [2, None], "columns": [None, None]}}]


def test_capture_plan_applies_options_to_spec(cube: Path) -> None:
    Path("scan.yml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy, frame_rate_hz: 7}}\nlevels: 2\n")
    with capture_plan(Path("scan.yml"), None, ["width=13"], ["rot90"]) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width, len(plan.levels)) == (7, 13, 2)
    assert plan.document["corrections"] == ["rot90"]
    with pytest.raises(SpecError), capture_plan(Path("scan.yml"), "nobody"):
        pass


@pytest.mark.parametrize("command", [["info"], ["convert", "out.npy"], ["preview", "-o", "out"]])
def test_unrecognised_capture_exits_2_and_lists_known_endings(
    cube: Path, invoke: Callable[..., Any], command: list[str]
) -> None:
    (cube.parent / "cube.dat").write_bytes(b"0123")
    name, *others = command
    result = invoke(name, "cube.dat", *others)
    assert (result.exit_code, result.stdout) == (2, "")
    first, *lines = result.stderr.splitlines()
    assert first == f"error: no source recognises {cube.parent}/cube.dat, a file of 4 bytes; name the one that reads it"
    (endings,) = lines
    assert endings.startswith("  the names of files of captures end in ")
    assert ".npy" in endings
    assert sorted(path.name for path in cube.parent.iterdir()) == ["capture.yaml", "cube.dat", "cube.npy"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": Path("no.npy")}, "there is no file or folder {folder}/no.npy; check the path"),
        ({"source": "nobody"}, "--source: there is no source 'nobody'; known: "),
        (
            {"source": "packed-npy", "keys": ["widht=4"]},
            "--with widht: unknown key; did you mean 'width'?",
        ),
        (
            {"keys": ["width=wide"]},
            "--with width: expected an integer of at least 1 or null, got 'wide' "
            "(cube.npy was recognised as packed-npy: uint8 of shape (20, 8, 2) in a .npy file)",
        ),
        ({"keys": ["width"]}, "--with width: expected KEY=VALUE, such as frame_rate_hz=96800"),
        ({"corrections": ["rot9"]}, "--correct: there is no correction 'rot9'; did you mean "),
    ],
)
def test_wrong_value_is_attributed_to_its_option(cube: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(WrongArgumentError) as caught, capture_plan(**{"path": Path("cube.npy")} | arguments):
        pass
    text = str(caught.value)
    assert text.startswith(message.replace("{folder}", str(cube.parent)))
    assert "override" not in text


@pytest.mark.parametrize("command", [["info"], ["convert", "out.npy"], ["preview", "-o", "out"], ["dark", "-o", "out.npz"]])
def test_problem_of_opened_capture_is_attributed_to_its_option(
    cube: Path, invoke: Callable[..., Any], command: list[str]
) -> None:
    name, *others = command
    result = invoke(name, "cube.npy", *others, "--correct", "{crop: {rows: [9, null]}}")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == ("error: --correct: there are no rows [9, null]: frames have 8 rows at this place of the list\n")


def test_unreadable_capture_names_recognised_source(folder: Path, invoke: Callable[..., Any]) -> None:
    pytest.importorskip("av")
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    result = invoke("info", "film.mp4")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.endswith(
        "export or copy it again (source video: film.mp4 was recognised: by its first bytes it is an MP4 or MOV file)\n"
    )


def test_refused_capture_names_recognised_source(folder: Path, invoke: Callable[..., Any]) -> None:
    (folder / "pictures").mkdir()
    (folder / "pictures" / "a.png").write_bytes(b"no picture")
    result = invoke("info", "pictures")
    assert result.exit_code == 2
    assert result.stderr.endswith("(pictures was recognised as image-folder: it holds 1 .png file)\n")


def test_missing_library_of_recognised_source_names_no_option(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *args: None if name == "av" else found(name, *args))
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    with pytest.raises(WrongArgumentError) as caught, capture_plan(Path("film.mp4")):
        pass
    assert str(caught.value).startswith("the source 'video' needs av, which is not installed: pip install ")


def test_check_and_explain_give_reason_of_automatic_source(cube: Path, invoke: Callable[..., Any]) -> None:
    Path("scan.yaml").write_text(
        "version: 1\nsource: {use: auto, with: {path: cube.npy}}\nresample: {with: {group_size: 5}}\nlevels: 1\n"
    )
    because = "cube.npy was recognised: uint8 of shape (20, 8, 2) in a .npy file"
    assert invoke("check", "scan.yaml").stdout == (
        f"scan.yaml: ok, 1 level on packed-npy: 20 binary frames of 8x16\nsource is packed-npy: {because}\n"
    )
    printed = invoke("explain", "scan.yaml").stdout
    assert f"\n  use: packed-npy  # photonpano 0.1.0, {because}\n" in printed
    assert f"\n    path: {cube}\n" in printed


@pytest.mark.parametrize("command", ["run", "check", "explain"])
def test_spec_command_given_a_capture_names_info(cube: Path, invoke: Callable[..., Any], command: str) -> None:
    result = invoke(command, "cube.npy")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "cube.npy: this is a capture, not a spec; `photonpano info cube.npy` reads it and prints a spec to start from\n"
        "error: the spec has 1 problem\n"
    )


@pytest.mark.parametrize(
    ("name", "arrange"),
    [
        ("cut.npy", lambda path: path.write_bytes(Path("cube.npy").read_bytes()[:-9])),
        ("large.npy", lambda path: np.save(path, np.zeros((2**15, 8, 8), np.uint8))),
        ("frames", lambda path: (path.mkdir(), Image.new("L", (16, 8)).save(path / "1.png"))),
    ],
    ids=["cut short", "larger than any spec", "folder"],
)
def test_run_names_info_for_any_recognised_capture(
    cube: Path, invoke: Callable[..., Any], name: str, arrange: Callable[[Path], Any]
) -> None:
    arrange(cube.parent / name)
    result = invoke("run", name)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"{name}: this is a capture, not a spec; ")


def test_run_reports_file_that_is_neither_spec_nor_capture(cube: Path, invoke: Callable[..., Any]) -> None:
    (cube.parent / "notes.txt").write_text("no spec")
    assert "is a capture" not in invoke("run", "notes.txt").stderr
