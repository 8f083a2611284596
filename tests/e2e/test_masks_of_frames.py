"""A bar before the sensor, for a third of the frames, that a mask of these frames leaves out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import SpecError, parse_spec, run
from photonpano.geometry import corners, inverse, transform_points, translation
from photonpano.pipeline.components import build_source
from photonpano.record.contents import fingerprint
from photonpano.testing.captures import detected, seen_along, textured
from photonpano.values import FloatArray, FrameSpan

pytestmark = pytest.mark.usefixtures("without_report")

SHAPE, N_FRAMES, SPAN = (96, 144), 1200, (400, 800)
BAR = np.s_[:, 48:96]
SCENE = cv2.GaussianBlur(textured((124, 224), 0.5, 0.8, 3), (0, 0), 2.0)


def _to_scene(frame: float) -> FloatArray:
    return translation(4 + 0.05 * frame, 14 + 10 * np.sin(frame / 200))


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A pan over which a bright, textured bar is pasted that stands still."""
    folder = tmp_path_factory.mktemp("bar")
    seen = seen_along(SCENE, np.stack([_to_scene(frame) for frame in range(N_FRAMES)]), SHAPE)
    seen[slice(*SPAN)][:, *BAR] = textured((96, 48), 2.0, 0.6, 9)
    np.save(folder / "capture.npy", np.packbits(detected(seen, 1), axis=-1))
    bad = np.zeros(SHAPE, np.bool_)
    bad[BAR] = True
    np.save(folder / "bar.npy", bad)
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(folder / "capture.npy")}},
        "corrections": [{"mask": {"file": str(folder / "bar.npy"), "frames": list(SPAN)}}],
        "resample": {"with": {"group_size": 90}},
        "levels": 2,
        "refine": [],
    }


def _error_px(folder: Path, first: int = 0) -> float:
    """Return the mean error of the motion of a run of the frames from the first on."""
    with np.load(folder / "trajectory.npz") as found:
        homographies, reference = found["homographies"], int(found["reference"])
    truth = np.stack([_to_scene(frame) for frame in range(first, N_FRAMES)])
    expected = transform_points(inverse(truth[reference]) @ truth, corners(SHAPE))
    return float(np.linalg.norm(transform_points(homographies, corners(SHAPE)) - expected, axis=-1).mean())


def test_masked_bar_leaves_motion_panorama_and_its_error_as_without_it(spec: dict[str, Any], tmp_path: Path) -> None:
    first = 100  # that is read; the frames of the mask are still those of the recording
    part = spec["source"]["with"] | {"frames": [first, N_FRAMES]}
    result = run(parse_spec(spec | {"source": {"use": "packed-npy", "with": part}}, output=tmp_path / "run"))
    assert result.record["verdict"]["status"] == "trusted"
    assert _error_px(tmp_path / "run", first) < 0.04
    with np.load(tmp_path / "run" / "trajectory.npz") as found:
        reference, canvas = int(found["reference"]), found["canvas"]
    truth = np.stack([_to_scene(frame) for frame in range(first, N_FRAMES)])
    flux, std, frames = (
        cv2.imread(str(tmp_path / "run" / name), cv2.IMREAD_UNCHANGED)
        for name in ("panorama.tiff", "panorama-std.tiff", "coverage.tiff")
    )
    y, x = np.indices(flux.shape)
    points = transform_points(truth[reference] @ inverse(canvas), np.stack([x, y], axis=-1).astype(float))
    known = seen_along(SCENE, [truth[reference] @ inverse(canvas)], flux.shape)[0]
    inner = np.zeros(flux.shape, np.bool_)
    inner[12:-12, 12:-12] = True
    inner &= frames > 200
    assert np.sqrt(np.mean(((flux - known) / std)[inner] ** 2)) == pytest.approx(1, abs=0.1)
    # While the bar is there, it hides each place for some time.
    passing = transform_points(inverse(truth), points[len(y) // 2])[..., 0]
    hidden = (passing > 47.5) & (passing < 95.5) & (np.arange(first, N_FRAMES) // SPAN[0] == 1)[:, None]
    seen = ((passing > -0.5) & (passing < SHAPE[1] - 0.5) & ~hidden).sum(axis=0)
    np.testing.assert_allclose(frames[len(y) // 2], seen, atol=25)


def test_a_mask_beyond_the_recording_is_an_error_and_other_frames_are_another_capture(spec: dict[str, Any]) -> None:
    def of(frames: list[int]) -> Any:
        return parse_spec(spec | {"corrections": [{"mask": spec["corrections"][0]["mask"] | {"frames": frames}}]})

    with pytest.raises(SpecError) as caught:
        build_source(of([800, 1201]))
    assert str(caught.value) == (
        "corrections.0.mask.frames: the capture has 1200 frames: expected [start, stop] with stop up to 1200, got [800, 1201]"
    )
    hashes = set()
    for frames in ([400, 800], [400, 801]):
        with build_source(of(frames)) as capture:
            hashes.add(fingerprint(of(frames), capture)["pixels_sha256"])
            assert capture.masked_in(FrameSpan(0, 1200)).valid.sum() == SHAPE[0] * 96
    assert len(hashes) == 2
