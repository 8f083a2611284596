"""Captures that are stored in another way than their spec says: `check` and `run` say it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano.api.cli.app import app

pytestmark = pytest.mark.usefixtures("without_report")

SPEC = """\
version: 1
source: {use: packed-npy, with: {path: cube.npy}}
resample: {with: {group_size: 48}}
levels: 1
refine: []
"""


@pytest.fixture
def spec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scan.yaml").write_text(SPEC)
    return tmp_path / "scan.yaml"


@pytest.mark.parametrize("command", ["check", "run"])
def test_wrong_order_of_bits_is_an_error_of_the_spec(spec: Path, clouds: Callable[..., np.ndarray], command: str) -> None:
    np.save("cube.npy", np.packbits(clouds(), axis=2, bitorder="little"))
    done = CliRunner().invoke(app, [command, "scan.yaml"])
    assert done.exit_code == 2
    path = spec.parent / "cube.npy"
    assert done.stderr.startswith(f"scan.yaml:2:1: source: {path} is packed in another order: pixels correlate by ")
    assert "; write bit_order: little, or bit_order: big if it is right\n" in done.stderr


def test_run_reads_what_the_message_said_to_write(spec: Path, clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds()
    panoramas = {}
    for name, stored, change in (
        ("right", np.packbits(frames, axis=2), []),
        (
            "both",
            np.packbits(frames, axis=1, bitorder="little"),
            ["source.with.bit_order=little", "source.with.packed_along=height"],
        ),
        ("bits", frames.astype(bool), ["source={use: npy, with: {path: cube.npy, holds: bits}}"]),
    ):
        np.save("cube.npy", stored)
        options = [word for each in (*change, f"output.directory={name}") for word in ("--set", each)]
        done = CliRunner().invoke(app, ["run", "scan.yaml", *options])
        assert done.exit_code == 0, done.output
        panoramas[name] = (spec.parent / name / "trajectory.npz").read_bytes()
    assert len(set(panoramas.values())) == 1


def test_sums_of_frames_run_and_packed_copies_of_bits_equal_their_source(spec: Path, clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds()
    np.save("bits.npy", frames)
    done = CliRunner().invoke(app, ["convert", "bits.npy", "packed.npy"])
    assert done.exit_code == 0, done.output
    np.testing.assert_array_equal(np.load("packed.npy"), np.packbits(frames, axis=2))
    np.save("cube.npy", frames.reshape(96, 4, 64, 96).sum(axis=1))
    source = "source={use: npy, with: {path: cube.npy, holds: sums, frames_per_sum: 4}}"
    done = CliRunner().invoke(app, ["run", "scan.yaml", "--set", source, "--set", "resample.with.group_size=12"])
    assert done.exit_code == 0, done.output
    assert json.loads(Path("runs/scan/run.json").read_text())["spec"]["source"]["with"]["frames_per_sum"] == 4
