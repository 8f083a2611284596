from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from photonpano.residuals.verdict import Reason
from photonpano.specs import load_spec, parse_spec


def test_simulate_prints_files_and_spec_section(finished: Path) -> None:
    assert (finished / "simulate.err").read_text() == ""
    size = (finished / "cube.truth.npz").stat().st_size
    assert (finished / "simulate.out").read_text() == (
        "cube.npy        384.1 kB  200 binary frames of 96x160 at 96,800 Hz\n"
        f"cube.truth.npz  {size / 1000:.1f} kB  the truth: motion and scene\n"
        "\n"
        "In a spec in this folder:\n"
        "\n"
        "source: {use: packed-npy, with: {path: cube.npy, frame_rate_hz: 96800}}\n"
        "\n"
        "To score a run of it: photonpano evaluate RUN --truth cube.truth.npz\n"
    )


def test_simulate_prints_valid_spec_section(finished: Path) -> None:
    line = next(line for line in (finished / "simulate.out").read_text().splitlines() if line.startswith("source:"))
    plan = parse_spec(f"version: 1\n{line}\n", directory=finished)
    assert plan.source.contribution.name == "packed-npy"


def test_run_prints_only_verdict_paths_and_warnings_into_pipe(finished: Path) -> None:
    record = json.loads((finished / "run" / "run.json").read_text())
    refined = [line for line in (finished / "run.out").read_text().splitlines(keepends=True) if line.startswith("refined ")]
    assert len(refined) == sum(bool(each["rounds"]) for each in record["refinements"])
    panorama = record["panorama"]
    decibels, measurable = panorama["dynamic_range_db"], panorama["measurable_range_db"]
    assert (finished / "run.out").read_text() == (
        f"verdict   {record['verdict']['status']}\n{''.join(refined)}"
        f"range     {decibels:.0f} dB, of {measurable:.0f} dB that the frames over a pixel can measure; "
        f"{100 * panorama['saturated_share']:.2g} % of the pixels are saturated\n"
        f"panorama  {finished}/run/panorama.png\nreport    {finished}/run/report.html\n"
    )
    reasons = [f"doubtful: {Reason(**reason)}\n" for reason in record["verdict"]["reasons"]]
    warnings = [f"warning: {warning}\n" for warning in record["warnings"]]
    lines = (finished / "run.err").read_text().splitlines(keepends=True)
    assert [line for line in lines if " after " not in line] == [*reasons, *warnings]  # a slow machine has lines of progress


def test_check_run_agrees_with_run(finished: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("check-run", finished / "run")
    assert result.stdout.splitlines()[0] == (finished / "run.out").read_text().splitlines()[0]


def test_evaluate_table_agrees_with_json(finished: Path, invoke: Callable[..., Any]) -> None:
    arguments = ["evaluate", finished / "run", "--truth", finished / "cube.truth.npz"]
    table = invoke(*arguments)
    assert table.exit_code == 0, table.stderr
    rows = dict(line.split("  ", 1) for line in table.stdout.splitlines())
    scores = json.loads(invoke(*arguments, "--json").stdout)
    assert {key.strip(): value.strip() for key, value in rows.items()} == {
        "corner error, mean": f"{scores['corner_error_px']['mean']:.3f} px",
        "corner error, median": f"{scores['corner_error_px']['median']:.3f} px",
        "corner error, 95 %": f"{scores['corner_error_px']['p95']:.3f} px",
        "corner error, worst frame": f"{scores['corner_error_px']['max']:.3f} px",
        "frames located": f"{100 * scores['located_share']:.1f} %",
        "frames within 3 std_px": f"{100 * scores['within_three_std_share']:.1f} %",
        "PSNR, panorama": f"{scores['panorama']['psnr_db']:.2f} dB",
        "SSIM, panorama": f"{scores['panorama']['ssim']:.4f}",
        "PSNR, oracle": f"{scores['oracle']['psnr_db']:.2f} dB",
        "SSIM, oracle": f"{scores['oracle']['ssim']:.4f}",
        "PSNR below the oracle": f"{scores['below_oracle_db']:.2f} dB",
    }
    assert scores["corner_error_px"]["mean"] < 1


def test_schema_is_printed_or_written(folder: Path, invoke: Callable[..., Any]) -> None:
    printed = json.loads(invoke("schema").stdout)
    assert {"version", "source", "levels"} <= set(printed["properties"])
    assert invoke("schema", "--output", "schema.json").stdout == "schema.json\n"
    assert json.loads((folder / "schema.json").read_text()) == printed


@pytest.mark.parametrize(
    "changes", [["levels=until-converged"], ["resample.with.group_size=auto"], ["levels=[{scale: 0.5}, {}]", "run.seed=3"]]
)
def test_explanation_is_the_same_spec(folder: Path, invoke: Callable[..., Any], changes: list[str]) -> None:
    printed = invoke("explain", "capture.yaml", *(word for change in changes for word in ("--set", change))).stdout
    assert YAML(typ="safe").load(printed) == parse_spec(printed).document == load_spec("capture.yaml", changes).document


def test_printed_sections_are_parts_of_specs(finished: Path, invoke: Callable[..., Any]) -> None:
    snippet = invoke("plugins", "show", "packed-npy").stdout.split("\n\n")[-1].replace('"<path>"', "cube.npy")
    spec = invoke("info", finished / "cube.npy").stdout.partition("start from:\n")[2]
    for text in (f"version: 1\n{snippet}", spec):
        assert parse_spec(text, directory=finished).source.contribution.name == "packed-npy"
