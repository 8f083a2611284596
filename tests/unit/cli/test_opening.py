"""How a capture is named on the command line that no spec names, and what is said if that is wrong."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.cli.capture import plan_for
from photonpano.cli.outcome import WrongArgumentError
from photonpano.errors import SpecError


@pytest.fixture
def cube(folder: Path) -> Path:
    np.save(folder / "cube.npy", np.zeros((20, 8, 2), np.uint8))
    return folder / "cube.npy"


def test_a_path_is_relative_to_the_current_folder(cube: Path) -> None:
    plan = plan_for(Path("cube.npy"))
    assert (plan.source.contribution.name, plan.source.config.path) == ("packed-npy", cube)


def test_values_are_yaml(cube: Path) -> None:
    plan = plan_for(Path("cube.npy"), "packed-npy", ["frame_rate_hz=1e3", "width=13"], ["rot90", "{crop: {rows: [2, null]}}"])
    assert (plan.source.config.frame_rate_hz, plan.source.config.width) == (1000, 13)
    assert plan.document["corrections"] == ["rot90", {"crop": {"rows": [2, None], "columns": [None, None]}}]


def test_a_spec_is_changed_by_the_same_options(cube: Path) -> None:
    Path("scan.yml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy, frame_rate_hz: 7}}\nlevels: 2\n")
    plan = plan_for(Path("scan.yml"), None, ["width=13"], ["rot90"], ["levels=1"])
    assert (plan.source.config.frame_rate_hz, plan.source.config.width, len(plan.levels)) == (7, 13, 1)
    assert plan.document["corrections"] == ["rot90"]
    with pytest.raises(SpecError):
        plan_for(Path("scan.yml"), "nobody")


@pytest.mark.parametrize("command", [["info"], ["convert", "out.npy"], ["preview", "-o", "out"]])
def test_a_capture_that_nobody_recognises(cube: Path, invoke: Callable[..., Any], command: list[str]) -> None:
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
            "(cube.npy is taken for packed-npy: uint8 of shape (20, 8, 2) in a .npy file)",
        ),
        ({"keys": ["width"]}, "--with width: expected KEY=VALUE, such as frame_rate_hz=96800"),
        ({"corrections": ["rot9"]}, "--correct: there is no correction 'rot9'; did you mean "),
    ],
)
def test_what_is_wrong_is_told_by_the_name_of_the_option(cube: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(WrongArgumentError) as caught:
        plan_for(**{"path": Path("cube.npy")} | arguments)
    told = str(caught.value)
    assert told.startswith(message.replace("{folder}", str(cube.parent)))
    assert "override" not in told


@pytest.mark.parametrize("command", [["info"], ["convert", "out.npy"], ["preview", "-o", "out"], ["dark", "-o", "out.npz"]])
def test_what_shows_when_the_capture_is_open_is_told_so_as_well(
    cube: Path, invoke: Callable[..., Any], command: list[str]
) -> None:
    name, *others = command
    result = invoke(name, "cube.npy", *others, "--correct", "{crop: {rows: [9, null]}}")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "error: --correct: the rows [9, null] are no part of a frame, which has 8 rows at this place of the list\n"
    )


def test_a_capture_that_cannot_be_opened_says_what_it_was_taken_for(folder: Path, invoke: Callable[..., Any]) -> None:
    pytest.importorskip("av")
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    result = invoke("info", "film.mp4")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.endswith(
        "export or copy it again (source video: film.mp4 is taken for it: by its first bytes it is an MP4 or MOV file)\n"
    )


def test_a_check_that_refuses_what_was_recognised_says_what_it_was_taken_for(folder: Path, invoke: Callable[..., Any]) -> None:
    (folder / "pictures").mkdir()
    (folder / "pictures" / "a.png").write_bytes(b"no picture")
    result = invoke("info", "pictures")
    assert result.exit_code == 2
    assert result.stderr.endswith("(pictures is taken for image-folder: it holds 1 .png file)\n")


def test_a_source_that_nobody_named_is_not_blamed_on_an_option(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *args: None if name == "av" else found(name, *args))
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    with pytest.raises(WrongArgumentError) as caught:
        plan_for(Path("film.mp4"))
    assert str(caught.value).startswith("the source 'video' needs av, which is not installed: pip install ")


def test_check_and_explain_say_what_auto_is_and_why(cube: Path, invoke: Callable[..., Any]) -> None:
    Path("scan.yaml").write_text(
        "version: 1\nsource: {use: auto, with: {path: cube.npy}}\nresample: {with: {group_size: 5}}\nlevels: 1\n"
    )
    because = "cube.npy is taken for it: uint8 of shape (20, 8, 2) in a .npy file"
    assert invoke("check", "scan.yaml").stdout == (
        f"scan.yaml: ok, 1 level on packed-npy: 20 binary frames of 8x16\nsource is packed-npy: {because}\n"
    )
    printed = invoke("explain", "scan.yaml").stdout
    assert f"\n  use: packed-npy  # photonpano 0.1.0, {because}\n" in printed
    assert f"\n    path: {cube}\n" in printed
