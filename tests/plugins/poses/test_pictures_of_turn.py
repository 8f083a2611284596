"""Pictures of a camera that turns, with the poses that other programs read."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import InputError, run
from photonpano.pipeline.run import RunResult
from photonpano.specs import parse_spec
from photonpano_poses import export

SHAPE, GROUP = (96, 144), 20
LENS = {"k1": -0.1}


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of a camera that turns by 30 degrees and sees through a lens. Tests must not change its folder."""
    scene = {"kind": "street", "width": 768, "height": 384}
    path = {"kind": "turn", "degrees": 30, "pitch_wobble_deg": 2, "wobbles": 1}
    camera: dict[str, Any] = {"scene": scene, "path": path, "n_frames": 250, "frame_shape": list(SHAPE), "flux": 1, "seed": 0}
    spec = {
        "version": 1,
        "source": {"use": "simulator", "with": camera | {"focal_length_px": 120, "distortion": LENS}},
        "motion": {"model": "rotation"},
        "camera": {"focal_px": 120, "distortion": LENS},
        "resample": {"use": "midpoint", "with": {"group_size": GROUP}},
        "levels": 1,
    }
    return run(parse_spec(spec, output=tmp_path_factory.mktemp("turn") / "run"))


@pytest.mark.parametrize("undistorted", [False, True])
def test_features_of_pictures_agree_with_the_rotations(turned: RunResult, tmp_path: Path, undistorted: bool) -> None:
    """COLMAP casts the ray of a feature of one picture into another: the same feature is found there, within 0.3 px."""
    pycolmap = pytest.importorskip("pycolmap")
    found = export(turned.directory, "colmap", tmp_path / "scene", images=True, undistorted=undistorted)
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    assert model.cameras[1].model.name == ("PINHOLE" if undistorted else "OPENCV")
    images = [model.images[number] for number in sorted(model.images)]
    assert found.n_frames == len(images) == 250 // GROUP
    assert [image.name for image in images[:2]] == ["exposure_000.png", "exposure_020.png"]
    assert {path.name for path in (tmp_path / "scene" / "images").iterdir()} == {image.name for image in images}
    for first, second in ((1, 3), (4, 7), (10, 6)):
        pictures = [cv2.imread(str(tmp_path / "scene" / "images" / images[place].name), 0) for place in (first, second)]
        assert all(picture.shape == SHAPE and picture.dtype == np.uint8 for picture in pictures)
        here, there = matches(*(cv2.GaussianBlur(picture, (0, 0), 1) for picture in pictures))
        turns = [images[place].cam_from_world().rotation.matrix() for place in (first, second)]
        rays = np.column_stack([model.cameras[1].cam_from_img(here + 0.5), np.ones(len(here))])
        expected = model.cameras[1].img_from_cam(rays @ turns[0] @ turns[1].T) - 0.5
        away = there - expected
        assert len(away) >= 10
        assert np.abs(np.median(away, axis=0)).max() < 0.3


def matches(first: Any, second: Any) -> tuple[Any, Any]:
    """Return where both pictures show a feature, (N, 2) each; integers are pixel centres in OpenCV."""
    sift = cv2.SIFT_create()
    (points, words), (others, other_words) = (sift.detectAndCompute(each, None) for each in (first, second))
    pairs = cv2.BFMatcher(crossCheck=True).match(words, other_words)
    here, there = (np.array([each.pt for each in found]) for found in (points, others))
    one, two = here[[pair.queryIdx for pair in pairs]], there[[pair.trainIdx for pair in pairs]]
    _, inliers = cv2.findHomography(one, two, cv2.RANSAC, 2.0)
    return one[inliers[:, 0] > 0], two[inliers[:, 0] > 0]


@pytest.mark.parametrize(
    ("file_format", "how", "message"),
    [
        (
            "tum",
            {"images": True},
            "the format tum has no pictures; leave out --images, or choose colmap, nerfstudio, openmvg or pto",
        ),
        ("colmap", {"undistorted": True}, "--bits, --undistorted and --capture are about pictures; add --images"),
        ("colmap", {"images": True, "bits": 12}, "bits: expected 8 or 16, got 12"),
        ("pto", {}, "a project of Hugin is one of pictures, from which it makes a panorama; add --images"),
    ],
)
def test_pictures_that_cannot_be_made_are_refused(
    turned: RunResult, tmp_path: Path, file_format: Any, how: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        export(turned.directory, file_format, tmp_path / "scene", **how)
    assert str(caught.value) == message
    assert not (tmp_path / "scene").exists()
