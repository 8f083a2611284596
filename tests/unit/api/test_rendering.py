"""Pictures of finished runs: rendered again, and as videos."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from photonpano import PhotonpanoError, parse_spec, render, run, video
from photonpano.pipeline.run import RunResult


def error_of(run_folder: Path, output: Path, *changes: str) -> str:
    with pytest.raises(PhotonpanoError) as caught:
        render(run_folder, output, changes)
    assert not output.exists() or output == run_folder
    return str(caught.value)


def test_rendering_is_that_of_a_whole_run(small_run: RunResult, tmp_path: Path) -> None:
    changes = ["render.scale=1.5", "render.extent=[10, 20, 90, 80]", "output.formats=[hdr]"]
    whole = run(parse_spec(dict(small_run.record["spec"]), overrides=changes, output=tmp_path / "whole"))
    again = render(small_run.directory, tmp_path / "again", changes)
    names = {"panorama.tiff", "panorama.png", "panorama.hdr", "panorama-std.tiff", "coverage.tiff", "trajectory.npz"}
    names |= {"first-frame.tiff", "last-frame.tiff"}
    assert set(again.record["files"]) == names
    assert {name: again.record["files"][name] for name in names} == {name: whole.record["files"][name] for name in names}
    differing = {key for key, value in whole.record.items() if again.record.get(key) != value}
    times = {"created", "seconds", "peak_memory_bytes", "panorama", "levels"}
    assert differing <= {*times, "files", "spec", "spec_file", "rendered_from"}
    assert again.record["rendered_from"] == str(small_run.directory)
    assert json.loads((tmp_path / "again" / "run.json").read_text()) == again.record


def test_turn_through_a_lens_is_rendered_again_on_a_sphere(tmp_path: Path) -> None:
    path = {"kind": "turn", "degrees": 60, "pitch_wobble_deg": 2, "wobbles": 1}
    scene = {"kind": "street", "width": 512, "height": 256}
    camera = {"scene": scene, "path": path, "n_frames": 240, "frame_shape": [64, 96], "flux": 0.5, "seed": 0}
    spec = {
        "version": 1,
        "source": {"use": "simulator", "with": camera | {"focal_length_px": 81, "distortion": {"k1": -0.1}}},
        "motion": {"model": "rotation"},
        "camera": {"focal_px": 81, "distortion": {"k1": -0.1}},
        "resample": {"use": "midpoint", "with": {"group_size": 20}},
        "levels": 1,
        "render": {"projection": "spherical"},
    }
    first = run(parse_spec(spec, output=tmp_path / "first"))
    again = render(first.directory, tmp_path / "again")
    names = "panorama.tiff", "panorama-std.tiff", "panorama.png", "coverage.tiff", "trajectory.npz"
    assert [again.record["files"][name] for name in names] == [first.record["files"][name] for name in names]


def test_capture_that_was_moved_is_named_and_changed_one_refused(
    small_run: RunResult, small_capture: Path, tmp_path: Path
) -> None:
    moved, folder = tmp_path / "moved.npy", tmp_path / "run"
    shutil.copytree(small_run.directory, folder)
    record = json.loads((folder / "run.json").read_text())
    record["spec"]["source"]["with"]["path"] = str(tmp_path / "gone.npy")
    (folder / "run.json").write_text(json.dumps(record))
    shutil.copy(small_capture, moved)
    output = tmp_path / "again"
    assert error_of(folder, output) == (
        f"{folder}: the capture of this run cannot be opened by its recorded spec (source: there is no file "
        f"{tmp_path / 'gone.npy'}; check the path); if it was moved, name it with --capture PATH, or, where a "
        "command has --set, with --set source.with.path=PATH"
    )
    again = render(folder, output, [f"source.with.path={moved}"])
    images = [tifffile.imread(each.directory / "panorama.tiff") for each in (again, small_run)]
    np.testing.assert_array_equal(*images)  # the file has the name of its capture
    assert [each["path"] for each in again.record["capture"]["files"]] == [str(moved)]
    np.save(moved, np.load(moved)[::-1])
    assert error_of(folder, tmp_path / "other", f"source.with.path={moved}") == (
        f"{folder}: the capture has other frames than when it was run; it is another capture"
    )


BOX = "render.extent=[10, 20, 90, 80]"


@pytest.mark.parametrize("name", ["film.webp", "film.gif", "film.mp4", "film"])
def test_video_has_its_pictures_in_every_format(small_run: RunResult, tmp_path: Path, name: str) -> None:
    made = video(small_run.directory, tmp_path / name, exposure=60, changes=[BOX])
    assert (made.n_pictures, made.shape, made.exposure, made.step) == (5, (60, 80), 60, 60)
    assert made.speed == pytest.approx(60 * 25 / 96_800)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if name == "film":
        files = sorted((tmp_path / name).iterdir())
        assert [file.name for file in files] == [f"frame_{number}.png" for number in range(5)]
        shapes = {
            (picture.shape, picture.dtype.name) for picture in (cv2.imread(str(each), cv2.IMREAD_UNCHANGED) for each in files)
        }
        assert shapes == {((60, 80), "uint16")}
    elif name == "film.mp4":
        av = pytest.importorskip("av")
        with av.open(str(tmp_path / name)) as film:
            assert [(each.height, each.width) for each in film.decode(video=0)] == 5 * [(60, 80)]
    else:
        with Image.open(tmp_path / name) as film:
            assert (film.n_frames, film.size) == (5, (80, 60))
