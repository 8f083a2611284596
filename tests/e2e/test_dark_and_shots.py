"""Frames without light, shots that nothing ties together, and motion that exposures do not show."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import LocationError, open_source
from photonpano import run as run_plan
from photonpano.execution.context import Context, Quiet
from photonpano.pipeline.obstacles import run_others, timeline_of
from photonpano.specs import parse_spec
from photonpano.specs.plan import Plan
from photonpano.values import FrameSpan

pytestmark = pytest.mark.usefixtures("without_report")

PAN = {"kind": "pan", "length_px": 60, "angle_deg": 10}
FIRST = FrameSpan(0, 42), FrameSpan(150, 190)


def spec_of(capture: Path) -> dict[str, Any]:
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture)}},
        "resample": {"use": "midpoint", "with": {"group_size": 30}},
        "motion": {"model": "translation"},
        "levels": 2,
        "refine": [],
    }


@pytest.fixture(scope="module")
def shutter_closes(simulated: Callable[..., Path]) -> Path:
    """The shutter is closed at first, and while the camera pans."""
    return simulated(path=PAN, shutter=[[0, 0.14], [0.5, 190 / 300]], sensor={"dark_rate": 0.002})


def dark_spans(capture: Path) -> tuple[FrameSpan, ...]:
    with open_source(parse_spec(spec_of(capture))) as source:
        return timeline_of(source, Context()).dark


def test_frames_without_light_are_found_to_the_frame(shutter_closes: Path) -> None:
    assert dark_spans(shutter_closes) == FIRST


def test_dark_frames_are_not_located_and_cost_the_others_nothing(
    shutter_closes: Path, simulated: Callable[..., Path], tmp_path: Path
) -> None:
    result = run_plan(parse_spec(spec_of(shutter_closes), output=tmp_path / "run"))
    dark = np.zeros(300, bool)
    for span in FIRST:
        dark[span.start : span.stop] = True
    with np.load(tmp_path / "run" / "trajectory.npz") as motion:
        located, path_px, reference = motion["located"], motion["homographies"][:, :2, 2], motion["reference"]
    np.testing.assert_array_equal(located, ~dark)
    assert (dark[150], reference) == (True, 149)  # the middle is dark, and nobody knows where it lies
    with np.load(shutter_closes.with_suffix(".truth.npz")) as truth:
        true_px = truth["homographies"][:, :2, 2]
    error = (path_px - (true_px - true_px[reference]))[~dark]
    assert np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)) < 0.15
    assert result.record["warnings"][0] == (
        "frames 0 to 41 and frames 150 to 189 show no light, as behind a closed shutter: they are not located, and left out of "
        "the panorama. If the shutter was meant to be open, check it, and the gate of the sensor"
    )
    decided = [(each["what"], each["value"]) for each in result.record["decisions"] if each["what"] == "dark_frames"]
    assert decided == [("dark_frames", "frames 0 to 41"), ("dark_frames", "frames 150 to 189")]
    # As bright as without a shutter.
    open_spec = spec_of(simulated(path=PAN, sensor={"dark_rate": 0.002}))
    run_plan(parse_spec(open_spec, output=tmp_path / "open"))
    assert flux_of(tmp_path / "run") == pytest.approx(flux_of(tmp_path / "open"), rel=0.03)


@pytest.fixture(scope="module")
def steady(simulated: Callable[..., Path]) -> Path:
    """A capture without a shutter, beside its run."""
    capture = simulated(path=PAN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "")
        run_plan(parse_spec(spec_of(capture), output=capture.parent / "run"))
    return capture


@pytest.mark.parametrize(("period", "n_dark"), [(2, 1), (30, 10)])
def test_frames_between_flashes_of_a_lamp_are_no_data(period: int, n_dark: int, steady: Path, tmp_path: Path) -> None:
    frames = np.load(steady)
    unlit = np.arange(len(frames)) % period >= period - n_dark
    frames[unlit] = 0
    flashed = tmp_path / "cube.npy"
    np.save(flashed, frames)
    result = run_plan(parse_spec(spec_of(flashed), output=tmp_path / "run"))
    n_unlit, first = int(unlit.sum()), period - n_dark
    assert result.record["warnings"][0] == (
        f"{n_unlit} of 300 frames, the first at {first}, show no light, as where a lamp flashes: they are left out, and the "
        "flux is that of the other frames"
    )
    assert result.verdict is not None
    assert [str(each) for each in result.verdict.reasons] == []
    assert flux_of(tmp_path / "run") == pytest.approx(flux_of(steady.parent / "run"), rel=0.01)


def test_dim_frames_are_light(steady: Path, tmp_path: Path) -> None:
    frames = np.load(steady)
    rng = np.random.default_rng(0)
    kept = [np.packbits(rng.random((100, *frames.shape[1:], 8)) < 0.1)[: frames[200:].size].reshape(frames[200:].shape)]
    frames[200:] &= kept[0]
    np.save(tmp_path / "cube.npy", frames)
    assert dark_spans(tmp_path / "cube.npy") == ()


def flux_of(run: Path) -> float:
    import tifffile

    return float(np.nanmedian(tifffile.imread(run / "panorama.tiff")))


@pytest.fixture(scope="module")
def two_shots(simulated: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 20 to 139 and 140 to 319 are of two shots; those before are not to be read."""
    elsewhere = {"kind": "street", "width": 1024, "height": 682, "seed": 5}
    first, other = (np.load(simulated(path=PAN, **changes)) for changes in ({}, {"scene": elsewhere}))
    path = tmp_path_factory.mktemp("shots") / "cube.npy"
    np.save(path, np.concatenate([first[:20], first[:120], other[:180]]))
    return path


def test_shots_that_nothing_ties_together_are_run_apart(
    two_shots: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spec = spec_of(two_shots) | {"render": {"reference": 30}}
    spec["source"]["with"]["frames"] = [20, 320]
    plan = parse_spec(spec, output=tmp_path / "run")
    result = run_plan(plan)
    with np.load(tmp_path / "run" / "trajectory.npz") as motion:
        np.testing.assert_array_equal(np.flatnonzero(motion["located"]), np.arange(120, 300))
        assert motion["reference"] == 210
    assert result.record["warnings"][0] == (
        "the capture holds 2 shots that no motion ties together: frames 0 to 119 and frames 120 to 299. The "
        "panorama is of frames 120 to 299 alone; the others have run folders of their own beside this one, unless their runs "
        "failed: frames 0 to 119 in run.panorama-2"
    )
    assert result.verdict is not None
    assert str(result.verdict.reasons[0]) == (
        "the capture holds shots that no motion ties together, and the panorama is of the longest alone (frames 0 "
        "to 119 and frames 120 to 299): 2, trusted up to 1; look at the panoramas of the others beside the run folder: "
        "DIR.panorama-2 and so on"
    )
    folder = tmp_path / "run.panorama-2"
    assert [each.directory for each in result.others] == [folder]
    assert str(folder / "report.html") in result._repr_html_()
    assert sorted(each.name for each in folder.iterdir()) == sorted([*result.others[0].record["files"], "run.json"])
    again = result.others[0].record["spec"]
    assert (again["source"]["with"]["frames"], again["output"]["directory"]) == ([20, 140], str(folder))
    with np.load(folder / "trajectory.npz") as motion:
        np.testing.assert_array_equal(motion["located"], np.ones(120, bool))
        assert motion["reference"] == 30

    # As if the run had been interrupted before the other shot.
    shutil.rmtree(folder)
    resumed = run_plan(plan, resume=True)
    assert [(each.was_finished, each.directory) for each in (resumed, *resumed.others)] == [
        (True, tmp_path / "run"),
        (False, folder),
    ]
    # A folder of the user is not touched, and costs the result nothing.
    (folder / "notes.txt").write_text("mine")
    refused = run_plan(plan, resume=True)
    assert (refused.record, refused.others) == (resumed.record, ())
    assert caplog.messages[-1] == (
        f"no panorama of frames 0 to 119, another shot, was written into {folder}: {folder} holds files that no run has "
        "written: notes.txt; choose another folder with --output, or write the results among them with --overwrite"
    )
    assert (folder / "notes.txt").read_text() == "mine"


def test_other_shots_are_numbered_by_their_length_and_those_that_fail_are_left_out(
    tiny_spec: dict[str, Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spans = [FrameSpan(0, 10), FrameSpan(10, 40), FrameSpan(40, 60), FrameSpan(60, 100)]
    record: Any = {
        "findings": {"shots": [{"start": each.start, "stop": each.stop} for each in spans]},
        "source": {"frame_rate_hz": 100.0},
    }

    def run(plan: Plan) -> Plan:
        if plan.output.directory.name == "run.panorama-3":
            raise LocationError("too dark")
        return plan

    imu = tmp_path / "imu.csv"
    imu.write_text("t_s,wx_rad_s,wy_rad_s,wz_rad_s\n0,0,0,0\n1,0,0,0\n")
    turning = {"motion": {"model": "rotation", "prior": {"imu": str(imu), "time_offset_s": 7.5}}, "camera": {"focal_px": 80}}
    spec = tiny_spec | turning | {"render": {"reference": 5, "movers": 15}}
    plans = list(run_others(parse_spec(spec, output=tmp_path / "run"), record, run, Quiet()))
    found = [(each.output.directory.name, each.document["source"]["with"]["frames"], each.document["render"]) for each in plans]
    assert [(name, frames, render["reference"], render["movers"]) for name, frames, render in found] == [
        ("run.panorama-2", [10, 40], "middle", 5),
        ("run.panorama-4", [0, 10], 5, "hide"),
    ]
    # The gyroscope's time at the first frame of each shot.
    priors = [(each.motion.prior, each.document["motion"]["prior"]) for each in plans]
    offsets_s = [(prior and prior.time_offset_s, document["time_offset_s"]) for prior, document in priors]
    assert offsets_s == [(7.6, 7.6), (7.5, 7.5)]
    name = tmp_path / "run.panorama-3"
    from_frame = "frames count from frame 40 of the capture"
    assert caplog.messages == [f"no panorama of frames 40 to 59, another shot, was written into {name}: {from_frame}: too dark"]
