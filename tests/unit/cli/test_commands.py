from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from photonpano import RunCheck
from photonpano.api.command import COMMANDS
from photonpano.cli.app import commands
from photonpano.pipeline.run import RunResult
from photonpano.residuals.verdict import Reason, Verdict
from photonpano.specs import load_spec, parse_spec


def answer(monkeypatch: pytest.MonkeyPatch, name: str, result: Any) -> None:
    """Let a command have a result without work."""
    commands()[name]
    module = f"photonpano.api.{name.replace('-', '_')}"
    monkeypatch.setitem(COMMANDS, module, replace(COMMANDS[module], calls=lambda **_: result))


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


@pytest.mark.usefixtures("folder")
def test_simulate_quotes_names_in_commands_that_are_copied(invoke: Callable[..., Any]) -> None:
    result = invoke("simulate", "capture.yaml", "-o", "night #1.npy", "--set", "source.with.n_frames=5")
    assert result.stdout.endswith("photonpano evaluate RUN --truth 'night #1.truth.npz'\n")


def test_simulate_prints_valid_spec_section(finished: Path) -> None:
    line = next(line for line in (finished / "simulate.out").read_text().splitlines() if line.startswith("source:"))
    plan = parse_spec(f"version: 1\n{line}\n", directory=finished)
    assert plan.source.contribution.name == "packed-npy"


def test_simulate_prints_width_unless_multiple_of_eight(folder: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("simulate", "capture.yaml", "-o", "odd.npy", "--set", "source.with.frame_shape=[20, 43]")
    assert "source: {use: packed-npy, with: {path: odd.npy, frame_rate_hz: 96800, width: 43}}" in result.stdout
    assert np.load(folder / "odd.npy").shape == (200, 20, 6)


def test_simulate_warns_of_masked_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    sensor = "source.with.sensor={hot_fraction: 0.01, mask_hot_pixels: true}"
    result = invoke("simulate", "capture.yaml", "-o", "hot.npy", "--set", sensor, "--set", "source.with.n_frames=5")
    assert result.exit_code == 0
    with np.load(folder / "hot.truth.npz") as truth:
        hot = int(truth["hot_pixels"].sum())
    assert hot > 0
    assert result.stderr == (
        f"warning: {hot} pixels of the capture are masked, and hot.npy holds no mask; mask them with `corrections`\n"
    )


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


TREMBLING = Reason("the image moves within groups", 24.1, 2.0, "scatter of the shifts over their noise", "use smaller groups")
SENTENCE = (
    "doubtful: the image moves within groups (scatter of the shifts over their noise): 24.1, trusted up to 2; "
    "use smaller groups\n"
)


@pytest.fixture
def run_with(folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Invoke `run` with a verdict that is given instead of found."""

    def run_with(verdict: Verdict, *arguments: str, **more: Any) -> Any:
        refined = {"use": "short-spans", "rounds": ["tremor at 223 Hz", "less"], "change_px": 0.664, "kept_out": None}
        still = {"use": "other", "rounds": [], "change_px": 0.0, "kept_out": None}
        record = {
            "warnings": ["a warning"],
            "refinements": [refined, still],
            "decisions": [],
            "files": {"report.html": {}},
            **more,
        }
        result = RunResult(folder / "run", record | more, verdict)
        monkeypatch.setattr("photonpano.api.run.run", lambda *_, **_options: result)
        return invoke("run", "capture.yaml", *arguments)

    return run_with


@pytest.mark.parametrize(("share", "end"), [(0.0, ""), (0.012, "; 1.2 % of the pixels are saturated")])
def test_run_prints_dynamic_range_and_saturated_pixels(
    folder: Path, run_with: Callable[..., Any], share: float, end: str
) -> None:
    panorama = {"dynamic_range_db": 71.2, "measurable_range_db": 99.9, "saturated_share": share}
    result = run_with(Verdict("trusted", (), 1.0), panorama=panorama)
    assert f"range     71 dB, of 100 dB that the frames over a pixel can measure{end}\n" in result.stdout


def test_run_prints_verdict_reasons_and_corrections(folder: Path, run_with: Callable[..., Any]) -> None:
    result = run_with(Verdict("doubtful", (TREMBLING,), 24.1))
    assert result.exit_code == 0
    assert result.stdout == (
        "verdict   doubtful\n"
        "refined   0.66 px on average by short-spans: tremor at 223 Hz\n"
        f"panorama  {folder}/run/panorama.png\n"
        f"report    {folder}/run/report.html\n"
    )
    assert result.stderr == f"{SENTENCE}warning: a warning\n"


def test_run_prints_the_motion_it_starts_with(run_with: Callable[..., Any]) -> None:
    start = {"what": "start", "value": "a turn by 3 degrees a frame", "reason": "it stands out"}
    size = {"what": "group_size", "value": 50, "reason": "chosen"}
    result = run_with(Verdict("trusted", (), 1.0), decisions=[start, size])
    assert "start     a turn by 3 degrees a frame: it stands out\n" in result.stdout
    assert "chosen" not in result.stdout


@pytest.mark.parametrize("arguments", [("--end-after", "3"), ("--follow", "--resume"), ("--resume", "--from-level", "2")])
def test_options_that_exclude_each_other_are_refused(run_with: Callable[..., Any], arguments: tuple[str, ...]) -> None:
    result = run_with(Verdict("trusted", (), 1.0), *arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {arguments[0]}")
    assert result.stdout == ""


def test_strict_run_fails_if_and_only_if_doubtful(run_with: Callable[..., Any]) -> None:
    result = run_with(Verdict("doubtful", (TREMBLING,), 24.1), "--strict")
    assert result.exit_code == 1
    assert result.stderr == (
        f"{SENTENCE}warning: a warning\n"
        "error: the verdict is doubtful, and --strict accepts only a trusted one; all files of the run folder are written\n"
    )
    assert run_with(Verdict("trusted", (), 1.02), "--strict").exit_code == 0


@pytest.mark.parametrize(("ratio", "scatter"), [(24.123, "24.12 times what noise explains"), (None, "unknown: too few frames")])
def test_check_run_prints_verdict_and_what_is_unknown(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, ratio: float | None, scatter: str
) -> None:
    found = RunCheck(Verdict("doubtful", (TREMBLING,), ratio), ("pairs are not judged",))
    answer(monkeypatch, "check-run", found)
    result = invoke("check-run", "run")
    assert (result.exit_code, result.stdout) == (0, f"verdict   doubtful\nscatter   {scatter}\n")
    assert result.stderr == f"{SENTENCE}warning: pairs are not judged\n"
    strict = invoke("check-run", "run", "--strict")
    assert strict.exit_code == 1
    assert strict.stderr.endswith(
        "error: the verdict is doubtful, and --strict accepts only a trusted one; nothing was written\n"
    )


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


def test_evaluate_omits_oracle_when_not_asked_for(finished: Path, invoke: Callable[..., Any]) -> None:
    arguments = ["evaluate", finished / "run", "--truth", finished / "cube.truth.npz", "--no-oracle"]
    assert "oracle" not in invoke(*arguments).stdout
    assert json.loads(invoke(*arguments, "--json").stdout)["oracle"] is None


def test_check_prints_ok_for_valid_spec(folder: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("check", "capture.yaml", "--set", "source.with.n_frames=4000")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == "capture.yaml: ok, 1 level on simulator: 4,000 binary frames of 96x160 at 96,800 Hz\n"


def test_check_and_explain_describe_levels_until_converged(folder: Path, invoke: Callable[..., Any]) -> None:
    arguments = ["capture.yaml", "--set", "levels=until-converged"]
    assert invoke("check", *arguments).stdout.startswith("capture.yaml: ok, up to 8 levels on simulator: ")
    printed = invoke("explain", *arguments).stdout
    comments = printed.partition("levels: until-converged")[0].splitlines()[-5:]
    assert comments == [
        "# up to 8 levels, until the motion has converged",
        "# level 1: 4 groups of 50 frames, 5 pairs, at scale 1",
        "# level 2: 9 groups of 25 to 50 frames, 20 pairs, at scale 1",
        "# level 3: 17 groups of 12 to 50 frames, 54 pairs, at scale 1",
        "# each further level: about twice the groups and pairs of the one before",
    ]
    assert parse_spec(printed).document == load_spec("capture.yaml", ["levels=until-converged"]).document


def test_check_and_explain_leave_automatic_group_size_open(folder: Path, invoke: Callable[..., Any]) -> None:
    arguments = ["capture.yaml", "--set", "resample.with.group_size=auto"]
    check = invoke("check", *arguments).stdout.splitlines()
    assert check[1:] == ["groups are chosen from flux and speed when the capture is read"]
    printed = invoke("explain", *arguments).stdout
    assert "  # level 1: groups are chosen from flux and speed when the capture is read; at scale 1\n" in printed
    assert "    group_size: auto  # --set\n" in printed
    assert parse_spec(printed).document == load_spec("capture.yaml", arguments[2:]).document


def test_explain_prints_resolved_spec(folder: Path, invoke: Callable[..., Any]) -> None:
    levels = "levels=[{scale: 0.5, locate: {with: {max_iterations: 7}}}, {}]"
    arguments = ["capture.yaml", "--set", levels, "--set", "run.seed=3"]
    result = invoke("explain", *arguments)
    assert result.exit_code == 0, result.stderr
    expected = load_spec("capture.yaml", [levels, "run.seed=3"]).document
    assert YAML(typ="safe").load(result.stdout) == expected
    assert parse_spec(result.stdout).document == expected


def test_explain_forecast_gives_time_and_memory(folder: Path, invoke: Callable[..., Any]) -> None:
    lines = invoke("explain", "capture.yaml", "--forecast", "--set", "resample.with.group_size=10").stdout.splitlines()
    assert re.fullmatch(r"# forecast from a trial on frames 40 to 159: about .* with \d+ threads? \(level 1: .*\)", lines[-2])
    assert re.fullmatch(r"# memory: about .* [MG]iB, for a panorama of about \d+ x \d+ px if no place is seen twice", lines[-1])


def test_explain_forecast_gives_reason_when_trial_fails(folder: Path, invoke: Callable[..., Any]) -> None:
    dark = ("--set", "source.with.flux=1e-6", "--set", "resample.with.group_size=10")
    lines = invoke("explain", "capture.yaml", "--forecast", *dark).stdout.splitlines()
    start = lines.index("# the trial in the middle of the capture failed, as the run may:")
    assert "level 1" in lines[start + 1]
    assert all(line.startswith("# ") for line in lines[start:])


def test_explain_marks_plugins_defaults_and_overrides(folder: Path, invoke: Callable[..., Any]) -> None:
    changed = "locate: {with: {max_iterations: 7}}\nlevels: [{locate: {}}, {}]"
    spec = (folder / "capture.yaml").read_text().replace("levels: 1", changed)
    (folder / "capture.yaml").write_text(spec)
    lines = [line.strip() for line in invoke("explain", "capture.yaml", "--set", "run.seed=3").stdout.splitlines()]
    assert lines[0] == "# capture.yaml as it will run, on 200 binary frames of 96x160 at 96,800 Hz"
    assert "use: simulator  # photonpano 0.1.0" in lines
    assert "use: direct  # photonpano 0.1.0, default" in lines
    assert "- use: opencv-sift  # photonpano 0.1.0, default" in lines
    assert "flux: 1" in lines
    assert "group_size: 50" in lines
    assert "endpoints: true  # default" in lines
    assert "max_iterations: 7" in lines
    assert "seed: 3  # --set" in lines
    assert f"directory: {folder}/runs/capture  # default" in lines
    assert "# level 1: 4 groups of 50 frames, 5 pairs, at scale 1" in lines
    assert "# level 2: 9 groups of 25 to 50 frames, 20 pairs, at scale 1" in lines


def test_explain_marks_origin_of_fallbacks(folder: Path, invoke: Callable[..., Any]) -> None:
    stages = (
        "locate: {use: direct, fallback: opencv-sift}\n"
        "levels:\n  - {locate: {with: {blur_px: 2}}}\n  - {locate: {fallback: {use: opencv-sift, with: {ratio: 0.9}}}}\n"
    )
    spec = (folder / "capture.yaml").read_text().replace("levels: 1\n", stages)
    (folder / "capture.yaml").write_text(spec)
    printed = invoke("explain", "capture.yaml").stdout
    assert YAML(typ="safe").load(printed) == load_spec("capture.yaml").document
    top, first, second = (part.partition("fallback:\n")[2].splitlines() for part in re.split("# level .:", printed))
    assert top[:2] == ["    - use: opencv-sift  # photonpano 0.1.0", "      with:"]
    assert "        max_keypoints: 2000  # default" in top
    assert first[:2] == ["        - use: opencv-sift  # photonpano 0.1.0", "          with:"]
    assert "            ratio: 0.8  # default" in first
    assert "            ratio: 0.9" in second
    replaced = invoke("explain", "capture.yaml", "--set", "locate.fallback=[]", "--set", "levels=1").stdout
    assert "  fallback: []  # --set\n" in replaced
    named = invoke("explain", "capture.yaml", "--set", "locate={use: opencv-sift, fallback: direct}").stdout
    assert "    - use: direct  # photonpano 0.1.0, --set\n" in named


def test_warm_up_prints_seconds(invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """`make test` compiles with it before any test."""
    answer(monkeypatch, "warm-up", 31.4)
    assert invoke("warm-up").stdout == "ready after 31 s\n"


def test_schema_is_printed_or_written(folder: Path, invoke: Callable[..., Any]) -> None:
    printed = json.loads(invoke("schema").stdout)
    assert {"version", "source", "levels"} <= set(printed["properties"])
    assert invoke("schema", "--output", "schema.json").stdout == "schema.json\n"
    assert json.loads((folder / "schema.json").read_text()) == printed
