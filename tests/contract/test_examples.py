"""Run every spec of examples/pipelines on a small capture."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from ruamel.yaml import YAML
from typer.testing import CliRunner

from photonpano import capture_plan, convert, load_trajectory, open_source, parse_spec
from photonpano.api.cli.app import app
from photonpano.capture.writing import truth_path
from photonpano.geometry import inverse

pytestmark = pytest.mark.documentation

EXAMPLES = Path(__file__).parents[2] / "examples" / "pipelines"
SMALL = {"source.with.n_frames": 240, "source.with.frame_shape": "[128, 160]", "source.with.path.length_px": 40}
SMALL_STREET = SMALL | {"source.with.scene": "{kind: street, width: 1024, height: 682}"}
GROUPS = {"resample.with.group_size": 50}
UNREFINED = GROUPS | {"refine": "[]", "light": "steady", "source.with.frames": "[0, 200]"}
SHORT = UNREFINED | {"levels": 2}
"""For specs that leave the number of levels to its default: 3 show no more than 2."""
CROPPED = {"corrections": "[{crop: {rows: [0, 72], columns: [0, 96]}}]"}
SMALL_NIGHT = {
    "source.with.n_frames": 600,
    "source.with.frame_shape": "[128, 160]",
    "source.with.scene": "{kind: night, width: 512, height: 341, range_db: 60}",
    "source.with.flux": 0.5,
    "resample.with.group_size": 150,
    "output.formats": "[hdr, exr]" if find_spec("OpenEXR") else "[hdr]",
}
SMALL_TRAVEL = {"source.with.n_frames": 240, "source.with.frame_shape": "[96, 144]"} | {
    f"{key}.focal_px": 128 for key in ("source.with", "camera")
}
CAPTURES = {
    "capture": SMALL_STREET | GROUPS,
    "room-capture": {
        "source.with.n_frames": 240,
        "source.with.frame_shape": "[128, 160]",
        "source.with.scene": "{kind: planes}",
    },
}
"""Specs to simulate, with overrides that make them small. The group size is checked, though it is not used."""
RUNS: dict[str, dict[str, Any]] = {
    "scan": GROUPS,
    "naive-average": SHORT,
    "constant-groups": SHORT,
    "sliding-window": SHORT,
    "super-resolution": SHORT | CROPPED,
    "gradual-super-resolution": UNREFINED | CROPPED,
    "coarse-to-fine": UNREFINED,
    "keypoints": SHORT,
    "orb": SHORT,
    "ecc": SHORT,
    "translation": UNREFINED,
    "smoothing-spline": GROUPS,
    "fallback": UNREFINED,
    "kornia": UNREFINED,
    "chain": SHORT,
    "colmap": SHORT,
    "swissspad": SHORT | CROPPED,
    "sums": SHORT | {"resample.with.group_size": 25, "source.with.frames": "[0, 100]"},
    "visionsim": SHORT,
    "zarr": SHORT,
    "vanvleck": SHORT,
    "cluster": SHORT | {"run.executor.with.workers": 1},
    "dark-scene": SMALL_STREET | {"levels": 2, "source.with.flux": 0.2, "resample.with.group_size": 60},
    "hot-pixels": SMALL_STREET | {"levels": 2, "source.with.flux": 0.5, "resample.with.group_size": 60},
    "colour": SMALL_STREET | SHORT | {"source.with.frame_shape": "[96, 128]", "resample.with.group_size": 60},
    "changing-light": SMALL_STREET
    | UNREFINED
    | {"source.with.n_frames": 400, "source.with.frame_shape": "[64, 96]", "source.with.frame_rate_hz": 5000}
    | {"levels": 2, "light": "auto"},
    "local-flow": SMALL_STREET
    | UNREFINED
    | {"source.with.frame_shape": "[64, 96]", "resample.with.group_size": 60, "levels": 2},
    "splat": SMALL_STREET | SHORT | {"source.with.flux": 0.2, "resample.with.group_size": 60},
    "revisits": SMALL_STREET
    | {"source.with.n_frames": 300, "source.with.path.length_px": 180, "source.with.path.row_spacing_px": 15}
    | {"source.with.frame_shape": "[80, 112]", "source.with.flux": 0.8, "resample.with.group_size": 20}
    | {"graph.skips": "[1, 2]"},
    "turn": {"source.with.n_frames": 300, "source.with.frame_shape": "[64, 96]", "source.with.path.degrees": 120}
    | {"source.with.scene.width": 512, "source.with.scene.height": 256, "source.with.focal_length_px": 81}
    | {"source.with.flux": 0.5, "resample.with.group_size": 20, "levels": 2},
    "high-dynamic-range": SMALL_NIGHT,
    "high-speed-video": {"resample.with.group_size": 8},
    "photograph": SMALL
    | {"source.with.n_frames": 300, "source.with.scene.width": 640}
    | {"source.with.path.length_px": 60, "source.with.path.row_spacing_px": 15},
}
"""Specs to run, with overrides that make them small."""
OTHERS = {"mandrill", "usaf", "nebula", "poses", "stratified-poses", "many-captures", "as-it-arrives", "windows"}
"""Specs that have tests of their own."""
SAME_GROUPS = {"constant-groups", "sliding-window"}
"""Specs with the same number of groups at every level."""
NEEDS = {
    "cluster": "distributed",
    "colmap": "pycolmap",
    "poses": "pycolmap",
    "stratified-poses": "gtsam",
    "high-speed-video": "av",
    "kornia": "kornia",
}
"""Optional libraries of specs, which run only if the library is installed."""
REPORTS = {"scan", "revisits", "high-speed-video"}
"""Specs whose reports are drawn; those of others show no more."""


STREET = {"kind": "street", "width": 1024, "height": 682}
CAMERA = {"scene": STREET, "path": {"kind": "pan", "length_px": 120}, "n_frames": 60, "frame_shape": [128, 160]}
"""The simulated camera of the example video."""


def photonpano(*arguments: str | Path, **overrides: Any) -> str:
    options = [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    done = CliRunner().invoke(app, [*map(str, arguments), *options])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def examples(tmp_path_factory, small_capture, simulated) -> Path:
    """A copy of the folder, with the files that the specs read."""
    folder = tmp_path_factory.mktemp("checkout") / "examples" / "pipelines"
    shutil.copytree(EXAMPLES, folder, ignore=shutil.ignore_patterns("runs", "*.npy", "*.npz"))
    shutil.copy(small_capture, folder / "capture.npy")
    shutil.copy(truth_path(small_capture), folder / "capture.truth.npz")
    frames = np.unpackbits(np.load(small_capture), axis=-1)
    np.save(folder / "sums.npy", frames[::2] + frames[1::2])
    convert(capture_plan(folder / "capture.npy", {"frame_rate_hz": 96800}, corrections=[]), folder / "capture.zarr")
    write_as_published(frames, folder)
    visionsim = folder / "visionsim"
    visionsim.mkdir()
    shutil.copy(small_capture, visionsim / "frames.npy")
    camera = {"h": 128, "w": 160, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy"}
    (visionsim / "transforms.json").write_text(json.dumps(camera | {"frames": [{}] * 300}))
    swissspad = folder / "swissspad"
    swissspad.mkdir()
    large = np.unpackbits(np.load(simulated(n_frames=240, frame_shape=[256, 512])), axis=-1)
    for number, frames in enumerate(np.split(large, 2)):
        np.packbits(frames, axis=-1, bitorder="little").tofile(swissspad / f"filename{number}.bin")
    rng = np.random.default_rng(0)
    blocks = cv2.resize(rng.uniform(0, 255, (40, 60)), (900, 600), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(folder / "photograph.jpg"), blocks + rng.normal(0, 10, blocks.shape))
    return folder


def write_as_published(frames: np.ndarray, folder: Path) -> None:
    """Write frames as the captures of the paper are laid out: with hot pixels, and one pixel in 16 behind a colour filter."""
    rng = np.random.default_rng(0)
    colours = np.eye(3, dtype=np.uint8)[rng.integers(0, 3, frames.shape[1:])] * 255
    coloured = rng.random(frames.shape[1:]) < 1 / 16
    hot = rng.random(frames.shape[1:]) < 0.002
    dimmed = frames & ~(coloured & (rng.random(frames.shape) < 0.7)) | hot
    capture = folder / "quantavision" / "pano" / "vanvleck"
    capture.mkdir(parents=True)
    np.save(capture / "binary.npy", np.packbits(dimmed, axis=-1))
    (capture / "arguments.json").write_text("{}")
    (folder / "masks").mkdir()
    np.save(folder / "masks" / "hot.npy", hot)
    cv2.imwrite(str(folder / "masks" / "filters.png"), np.where(coloured[..., None], colours, 255))


def test_every_example_spec_is_in_this_file():
    assert {file.stem for file in EXAMPLES.glob("*.yaml")} == {*CAPTURES, *RUNS, *OTHERS}


def test_examples_readme_links_every_spec():
    page = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert [file.name for file in EXAMPLES.glob("*.yaml") if f"[{file.name}]({file.name})" not in page] == []


@pytest.mark.parametrize("name", CAPTURES)
def test_example_captures_simulate(name, examples, tmp_path):
    photonpano("simulate", examples / f"{name}.yaml", "--output", tmp_path / "cube.npy", **CAPTURES[name])
    assert np.load(tmp_path / "cube.npy", mmap_mode="r").shape == (240, 128, 20)


@pytest.mark.parametrize("name", RUNS)
def test_example_specs_run(name, examples, tmp_path, write_video, request):
    if name not in REPORTS:
        request.getfixturevalue("without_report")
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    if name == "high-speed-video":
        with open_source(parse_spec({"version": 1, "source": {"use": "camera-simulator", "with": CAMERA}})) as camera:
            video = write_video(camera.frames(camera.info.span), "a.mp4", "libx264", "yuvj420p")
        shutil.copy(video, examples / "high-speed.mp4")
    photonpano("run", examples / f"{name}.yaml", "--output", tmp_path / "run", **RUNS[name])
    formats = {file.suffix for file in (tmp_path / "run").glob("panorama.*")} - {".tiff", ".png"}
    assert formats == ({".hdr", *([".exr"] if find_spec("OpenEXR") else [])} if name == "high-dynamic-range" else set())
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    groups = [level["groups"] for level in record["levels"]]
    assert all(level["located"] == level["groups"] for level in record["levels"])
    assert groups[1] == (groups[0] if name in SAME_GROUPS else 2 * groups[0] + 1)
    assert ({level["scale"] for level in record["levels"]} == {0.5, 1}) == (name == "coarse-to-fine")
    assert record["panorama"]["scale"] == (2 if name.endswith("super-resolution") else 1)
    decided = {*record["panorama"]["decisions"]} - {"background_never_seen"}
    assert bool(decided) == (record["spec"]["render"]["use"] == "super-resolution")
    assert ("group_size" in {decision["what"] for decision in record["decisions"]}) == (name == "photograph")
    assert record["spec"]["merge"]["with"].get("compensate", True) == (name != "naive-average")
    assert any(level["revisits"]["located"] for level in record["levels"]) == (name == "revisits")
    assert ("levels" in {decision["what"] for decision in record["decisions"]}) == (name == "revisits")


def test_excluded_pairs_mend_a_scene_that_repeats(examples, tmp_path, without_report):
    windows = runpy.run_path(str(examples / "windows.py"))
    windows["main"](examples)
    truth = np.array([windows["to_scene"](frame) for frame in range(windows["N_FRAMES"])])
    errors_px = {}
    for name, changes in (("bent", {"graph.exclude": "[]"}), ("mended", {})):
        photonpano("run", examples / "windows.yaml", "--output", tmp_path / name, **changes)
        found = load_trajectory(tmp_path / name).homographies
        moved = (inverse(found[150]) @ found[500])[:2, 2] - (inverse(truth[150]) @ truth[500])[:2, 2]
        errors_px[name] = float(np.hypot(*moved))
    assert errors_px["bent"] == pytest.approx(windows["WINDOW_PX"], abs=1)
    assert errors_px["mended"] < 1
    failures = json.loads((tmp_path / "bent" / "run.json").read_text())["levels"][0]["failures"]
    (reason,) = [each["reason"] for each in failures if (each["moving"], each["fixed"]) == ([450, 500], [250, 300])]
    assert re.fullmatch(r"opencv-sift: the motion is \d+ px from that along the pairs of direct in between", reason)


def test_example_follows_a_program_that_writes_frames(examples, tmp_path):
    """Both are processes of their own, with a pipe between them."""
    frames = examples / "capture.npy"
    write = f"import numpy, sys; sys.stdout.buffer.write(numpy.load({str(frames)!r}).tobytes())"
    changes = ("source.with.height=128", "source.with.width=160", "resample.with.group_size=50", "levels=1", "refine=[]")
    command = [
        sys.executable,
        "-m",
        "photonpano",
        "run",
        examples / "as-it-arrives.yaml",
        "--follow",
        "--output",
        tmp_path / "run",
    ]
    with subprocess.Popen([sys.executable, "-c", write], stdout=subprocess.PIPE) as writer:
        done = subprocess.run(
            [*command, *(word for change in changes for word in ("--set", change))],
            stdin=writer.stdout,
            capture_output=True,
            text=True,
            check=False,
        )
    assert (writer.returncode, done.returncode) == (0, 0), done.stderr
    assert (tmp_path / "run.live" / "frames.raw").read_bytes() == np.load(frames).tobytes()
    photonpano("run", examples / "scan.yaml", "--output", tmp_path / "scan", levels=1, refine="[]", **GROUPS)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == (tmp_path / "scan" / "trajectory.npz").read_bytes()
    for name in ("panorama.tiff", "coverage.tiff"):  # whose files name the capture
        np.testing.assert_array_equal(*(tifffile.imread(tmp_path / folder / name) for folder in ("run", "scan")))


def test_example_of_a_real_capture_runs(examples, tmp_path, without_report):
    """Groups of 16 frames are located along the velocity that all frames show: of the mean turn of a fan."""
    corrections = "[{mask: {file: mandrill/mask.png}}, {crop: {rows: [112, 336], columns: [112, 336]}}, flat-field]"
    small = {"corrections": corrections, "refine": "[]", "levels": 1, "light": "steady"}
    photonpano("run", examples / "mandrill.yaml", "--output", tmp_path / "run", **small)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["levels"][0]["located"] == record["levels"][0]["groups"] == 6
    start = next(decision for decision in record["decisions"] if decision["what"] == "start")
    assert start["value"].startswith("a turn by -3.7")
    homographies = np.load(tmp_path / "run" / "trajectory.npz")["homographies"]
    turned = np.degrees(np.unwrap(np.arctan2(homographies[:, 1, 0], homographies[:, 0, 0])))
    assert np.polyfit(np.arange(len(turned)), turned, 1)[0] == pytest.approx(3.71, abs=0.05)
    # Also in the frames before the middle of the first exposure, and after that of the last.
    np.testing.assert_allclose(np.diff(turned), 3.71, atol=0.3)
    assert "usaf.yaml: ok" in photonpano("check", examples / "usaf.yaml")


def test_example_of_a_telescope_follows_its_star_tracker(examples, tmp_path, without_report):
    """The first fifth of the frames, at level 1: it misses less than a quarter of the sway, which is 4 px on either side."""
    n_frames = 1200
    with np.load(EXAMPLES / "nebula" / "photons.npz") as photons, np.load(EXAMPLES / "nebula" / "truth.npz") as truth:
        kept, known = photons["frame"] < n_frames, truth["homographies"][:n_frames, :2, 2]
        np.savez(tmp_path / "photons.npz", **{name: photons[name][kept] for name in photons})
    small = {"source.with.path": tmp_path / "photons.npz", "levels": 1, "refine": "[]"}
    photonpano("run", examples / "nebula.yaml", "--output", tmp_path / "run", **small)
    found = load_trajectory(tmp_path / "run").homographies[:, :2, 2]
    missed = (found - found.mean(axis=0)) - (known - known.mean(axis=0))
    assert (
        np.sqrt((missed**2).sum(axis=1).mean()) < 0.9 < 0.25 * np.sqrt(((known - known.mean(axis=0)) ** 2).sum(axis=1).mean())
    )


def test_captures_of_the_paper_are_unpacked_from_their_archive(examples, tmp_path):
    """A bucket that is a folder, with archives as the public one has, and hot pixels that are False."""
    bucket, published = tmp_path / "bucket", examples / "quantavision" / "pano" / "vanvleck"
    (bucket / "quantavision" / "pano").mkdir(parents=True)
    with zipfile.ZipFile(bucket / "quantavision" / "pano" / "pano_1.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("binary.npy", "arguments.json"):
            archive.write(published / name, f"vanvleck/{name}")
            archive.writestr(f"cs6floorlounge/{name}", "another capture")
    (bucket / "quantavision" / "color.zip").write_bytes(b"an archive that is not opened")
    hot = np.load(examples / "masks" / "hot.npy")
    with (
        zipfile.ZipFile(bucket / "quantavision" / "masks.zip", "w") as archive,
        archive.open("hot_pixel_mask/colorSPAD_continuous_stream.npy", "w") as file,
    ):
        np.save(file, (~hot).astype(np.uint8))
    script = runpy.run_path(str(examples / "paper_captures.py"))
    script["download"]("vanvleck", tmp_path, f"file://{bucket}", f"file://{examples / 'masks' / 'filters.png'}")
    assert (tmp_path / "quantavision/pano/vanvleck/binary.npy").read_bytes() == (published / "binary.npy").read_bytes()
    np.testing.assert_array_equal(np.load(tmp_path / "masks" / "hot.npy"), hot)
    shutil.copy(examples / "vanvleck.yaml", tmp_path)
    assert "vanvleck.yaml: ok" in photonpano("check", tmp_path / "vanvleck.yaml")
    with pytest.raises(SystemExit, match=r"has no vanvleck2/binary\.npy and no vanvleck2/arguments\.json; it may have moved"):
        script["download"]("vanvleck2", tmp_path, f"file://{bucket}", "")


@pytest.mark.parametrize(
    ("name", "small", "pictures", "std"),
    [
        ("poses", {"pose.with.group_size": 15}, 16, 0.03),
        ("stratified-poses", {"pose.with.group_size": 30, "pose.with.levels": 2}, 0, 0.01),
    ],
)
def test_example_of_poses_runs(examples, tmp_path, without_report, name, small, pictures, std):
    pytest.importorskip(NEEDS[name])
    printed = photonpano("run", examples / f"{name}.yaml", "--output", tmp_path / "run", **SMALL_TRAVEL, **small)
    assert "located   240 of 240 frames" in printed
    assert len(list((tmp_path / "run" / "images").glob("*.png"))) == pictures
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["poses"]["std_position"] < std


def test_tutorial_specs_equal_example_specs():
    page = (EXAMPLES.parents[1] / "docs" / "tutorial" / "first-panorama.md").read_text(encoding="utf-8")
    yaml = YAML(typ="safe")
    for name in ("capture.yaml", "scan.yaml"):
        shown = yaml.load(page.partition(f"<!-- file: {name} -->\n```yaml\n")[2].partition("```")[0])
        example = yaml.load((EXAMPLES / name).read_text(encoding="utf-8"))
        if name == "capture.yaml":  # the tutorial's is smaller, as the tests follow it in full
            camera = shown["source"]["with"]
            camera["path"]["length_px"], camera["n_frames"] = 300, 3000
            assert camera.pop("frame_shape") == [128, 256]
        assert shown == example
