"""What other programs may rely on in a run folder."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from photonpano.geometry import corners, transform_points
from photonpano.photometry import tone_mapped
from photonpano.pipeline.run import RunResult
from photonpano.record.schema import LevelRecord, RunRecord
from photonpano.specs import parse_spec

N_FRAMES, SHAPE = 300, (128, 160)


@pytest.fixture(scope="module")
def folder(small_run: RunResult) -> Path:
    return small_run.directory


@pytest.fixture(scope="module")
def record(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def trajectory(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "trajectory.npz", allow_pickle=False) as archive:
        return dict(archive)


def test_maps_say_what_they_hold(folder: Path, small_capture: Path) -> None:
    for name, content in {
        "panorama": "flux",
        "coverage": "number of frames",
        "first-frame": "number of the first frame",
    }.items():
        with tifffile.TiffFile(folder / f"{name}.tiff") as file:
            (about,) = file.shaped_metadata
        assert about["content"].startswith(content)
        assert about["pixels_per_frame_pixel"] == pytest.approx(1, rel=0.1)
        assert about["capture"] == small_capture.name


def test_run_folder_holds_exactly_the_promised_files(folder: Path) -> None:
    assert {file.name for file in folder.iterdir()} == {
        "panorama.tiff",
        "panorama-std.tiff",
        "panorama.png",
        "coverage.tiff",
        "first-frame.tiff",
        "last-frame.tiff",
        "trajectory.npz",
        "run.json",
        "report.html",
    }


def test_standard_deviation_of_the_flux_is_known_where_it_is_seen(folder: Path) -> None:
    flux, coverage, std = (tifffile.imread(folder / f"{name}.tiff") for name in ("panorama", "coverage", "panorama-std"))
    assert std.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(std), np.isnan(flux))
    seen = coverage > 0.5 * N_FRAMES
    photons = np.sqrt(np.expm1(flux[seen]) / coverage[seen])
    assert 0.6 < np.median(std[seen] / photons) < 1.1


def test_panorama_is_linear_flux_and_nan_where_unseen(folder: Path) -> None:
    flux, coverage = tifffile.imread(folder / "panorama.tiff"), tifffile.imread(folder / "coverage.tiff")
    assert flux.dtype == coverage.dtype == np.float32
    assert flux.shape == coverage.shape
    np.testing.assert_array_equal(np.isnan(flux), coverage == 0)
    assert 0.3 < np.nanmean(flux) < 0.8
    assert np.nanmin(flux) >= 0
    assert coverage.max() <= N_FRAMES + 0.01
    assert set(np.unique(coverage[(coverage > 0) & (coverage < 1)])) == set()


def test_picture_is_the_panorama_in_srgb(folder: Path, record: dict[str, Any]) -> None:
    picture = cv2.imread(str(folder / "panorama.png"), cv2.IMREAD_UNCHANGED)
    flux = tifffile.imread(folder / "panorama.tiff")
    white = record["panorama"]["white_flux"]
    assert white == pytest.approx(np.nanquantile(flux, 0.995))
    seen = ~np.isnan(flux)
    np.testing.assert_array_equal(picture[seen], np.maximum(tone_mapped(flux, white)[seen], 1))
    with Image.open(folder / "panorama.png") as opened:  # what no frame saw is transparent
        np.testing.assert_array_equal(np.asarray(opened.convert("RGBA"))[..., 3] > 0, seen)


def test_trajectory_maps_frames_to_the_reference_frame(trajectory: dict[str, np.ndarray]) -> None:
    homographies = trajectory["homographies"]
    assert {name: array.shape for name, array in trajectory.items()} == {
        "homographies": (N_FRAMES, 3, 3),
        "canvas": (3, 3),
        "projection": (),
        "horizon": (3, 3),
        "frame_shape": (2,),
        "reference": (),
        "located": (N_FRAMES,),
        "std_px": (N_FRAMES,),
    }
    assert homographies.dtype == trajectory["canvas"].dtype == np.float64
    assert trajectory["located"].dtype == np.bool_
    assert np.issubdtype(trajectory["reference"].dtype, np.integer)
    assert tuple(trajectory["frame_shape"]) == SHAPE
    reference = int(trajectory["reference"])
    assert reference == N_FRAMES // 2
    np.testing.assert_allclose(homographies[reference], np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(homographies[:, 2, 2], 1)


def test_canvas_maps_the_reference_frame_to_the_panorama(folder: Path, trajectory: dict[str, np.ndarray]) -> None:
    """Every located frame lies on the panorama, and its middle was seen."""
    coverage = tifffile.imread(folder / "coverage.tiff")
    to_panorama = trajectory["canvas"] @ trajectory["homographies"][trajectory["located"]]
    placed = transform_points(to_panorama, corners(SHAPE))
    assert placed.min() > -0.5
    assert (placed.max(axis=(0, 1)) < np.array(coverage.shape[::-1]) - 0.5).all()
    middles = np.rint(transform_points(to_panorama, [[(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2]])[:, 0]).astype(int)
    assert coverage[middles[:, 1], middles[:, 0]].min() > 100


def test_coverage_counts_the_located_frames(folder: Path, trajectory: dict[str, np.ndarray]) -> None:
    """The maps hardly change areas here: the sum is frames times pixels of a frame."""
    coverage = tifffile.imread(folder / "coverage.tiff")
    assert coverage.sum() == pytest.approx(trajectory["located"].sum() * SHAPE[0] * SHAPE[1], rel=0.02)


def test_record_names_source_components_and_versions(record: dict[str, Any], small_spec: dict[str, Any], folder: Path) -> None:
    assert record["status"] == "done"
    assert record["seed"] == 0
    assert record["source"] == {
        "n_frames": N_FRAMES,
        "height": SHAPE[0],
        "width": SHAPE[1],
        "frame_rate_hz": 96800,
        "kind": "binary",
    }
    assert [(plugin["stage"], plugin["use"]) for plugin in record["plugins"]] == [
        ("source", "packed-npy"),
        ("resample", "midpoint"),
        ("merge", "photon-mle"),
        ("locate", "direct"),
        ("locate", "opencv-sift"),
        ("interpolate", "smoothing-spline"),
        ("refine", "short-spans"),
        ("render", "merge"),
    ]
    assert all(plugin["plugin"] == "photonpano" and plugin["version"] for plugin in record["plugins"])
    assert {"python", "numpy", "opencv-python-headless", "scipy"} <= set(record["libraries"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", record["created"])
    assert record["peak_memory_bytes"] is None or 50e6 < record["peak_memory_bytes"] < 4e9
    assert record["seconds"] > 0


def test_recorded_spec_resolves_to_the_same_document(record: dict[str, Any], small_spec: dict[str, Any], folder: Path) -> None:
    again = parse_spec(record["spec"])
    assert again.document == parse_spec(small_spec, output=folder).document
    assert again.source.config.path.is_absolute()


def test_record_has_an_entry_for_every_level(record: dict[str, Any]) -> None:
    levels = record["levels"]
    assert [level["level"] for level in levels] == [1, 2, 3]
    assert [level["groups"] for level in levels] == [6, 13, 25]
    assert levels[0]["change_px"] is None
    assert levels[1]["change_px"] > levels[2]["change_px"] > 0
    for level in levels:
        assert level["located"] == level["groups"]
        assert level["pairs"] >= level["groups"] - 1
        assert set(level["seconds"]) == {"resample", "merge", "locate", "interpolate"}
        for failure in level["failures"]:
            assert set(failure) == {"moving", "fixed", "reason", "evidence"}


def test_report_needs_no_other_file_and_links_those_of_the_run(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"""src=["'](?!data:)[^"']*""", page) == []
    links = set(re.findall(r"""href=["'](?!data:|#)([^"']*)""", page))
    assert links == {f"./{file.name}" for file in folder.iterdir()} - {"./report.html"}
    assert "data:image/png;base64," in page


def mismatches(value: Any, expected: Any, where: str = "run.json") -> list[str]:
    """Return where plain data differs from a TypedDict, a sequence, a mapping, a union, or a plain type."""
    if is_typeddict(expected):
        if not isinstance(value, Mapping):
            return [f"{where}: {value!r} is no {expected.__name__}"]
        hints = get_type_hints(expected)
        if set(value) != set(hints):
            return [f"{where}: {sorted(set(value) ^ set(hints))}"]
        return [each for key, hint in hints.items() for each in mismatches(value[key], hint, f"{where}.{key}")]
    origin, arguments = get_origin(expected), get_args(expected)
    if origin is UnionType:
        found = [mismatches(value, each, where) for each in arguments]
        return [] if [] in found else min(found, key=len)
    if origin is Sequence:
        return [each for index, item in enumerate(value) for each in mismatches(item, arguments[0], f"{where}.{index}")]
    if origin is Mapping:
        return [each for key, item in value.items() for each in mismatches(item, arguments[1], f"{where}.{key}")]
    allowed = (int, float) if expected is float else object if expected is Any else expected
    return [] if isinstance(value, allowed) else [f"{where}: {value!r} is no {expected}"]


def test_record_has_the_keys_and_types_of_its_schema(record: dict[str, Any]) -> None:
    assert mismatches(record, RunRecord) == []


@pytest.mark.parametrize("schema", [RunRecord, LevelRecord])
def test_page_on_the_run_folder_lists_every_key(schema: type) -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "run-folder.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert set(get_type_hints(schema)) <= listed
