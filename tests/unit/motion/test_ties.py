"""Points tied by hand: what the file may hold, the motion they give, and exposures that are left out of registration."""

from pathlib import Path

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Located, NotLocated, StreamInfo
from photonpano.geometry import inverse, transform_points, translation
from photonpano.motion.pairs import TIE, read_ties, require_agreement, tied_pairs
from photonpano.testing import KnownMotion
from photonpano.testing.captures import rolled
from photonpano.values import Edge

SHAPE = (80, 120)
INFO = StreamInfo(1000, *SHAPE, "binary", 1000.0)
HEADER = "frame_a,x_a,y_a,frame_b,x_b,y_b\n"
COLUMNS = "the first line must name the columns frame_a, x_a, y_a, frame_b, x_b, y_b and, if wanted, std_px; it is "
GROUPS = [Group(FrameSpan(start, start + 100), start + 49.5) for start in range(0, 1000, 100)]
POINTS = np.array([[20.0, 30.0], [70.0, 20.0], [60.0, 65.0], [30.0, 60.0], [50.0, 40.0]])


def written(path: Path, motion: np.ndarray, n: int = 5, frames: tuple[int, int] = (150, 750), wrong_px: float = 0.0) -> Path:
    """Write n ties whose points in the second frame a motion maps to the first; the last one is wrong."""
    there = transform_points(motion, POINTS[:n])
    there[-1, 0] += wrong_px
    lines = [f"{frames[0]},{a[0]},{a[1]},{frames[1]},{b[0]},{b[1]}\n" for a, b in zip(there, POINTS[:n], strict=True)]
    path.write_text(HEADER + "".join(lines))
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", COLUMNS + "''"),
        ("frame,x,y\n", COLUMNS + "'frame,x,y'"),
        (HEADER, "holds no ties; write a line for each, below the names of the columns, or remove graph.tie"),
        (HEADER + "1,2,3,4,5\n", "line 2: expected a value for each of the 6 columns"),
        (HEADER + "1,2,3,4,5,6,7\n", "line 2: expected a value for each of the 6 columns"),
        (HEADER + "1,2,3,1000,5,6\n", "line 2, column frame_b: expected a frame of the capture, 0 to 999, got '1000'"),
        (HEADER + "1.5,2,3,400,5,6\n", "line 2, column frame_a: expected a frame of the capture, 0 to 999, got '1.5'"),
        (HEADER + "1,120,3,400,5,6\n", "line 2, column x_a: expected px, -0.5 to 119.5, got '120'"),
        (HEADER + "1,2,nan,400,5,6\n", "line 2, column y_a: expected px, -0.5 to 79.5, got 'nan'"),
        (HEADER + "1,2,3,400,5,here\n", "line 2, column y_b: expected px, -0.5 to 79.5, got 'here'"),
        (HEADER + "7,2,3,7,5,6\n", "line 2, column frame_b: expected another frame than frame_a, got 7 for both"),
        (HEADER.strip() + ",std_px\n1,2,3,400,5,6,0\n", "line 2, column std_px: expected px, 0.01 to 1000, got '0'"),
    ],
)  # fmt: skip
def test_wrong_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (file := tmp_path / "ties.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_ties(file, INFO)
    assert str(caught.value).removeprefix(str(file)).lstrip(":, ") == message


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_ties_give_a_shift_a_roll_or_a_homography(tmp_path: Path, n: int) -> None:
    bent = np.array([[1.1, 0.05, 8.0], [-0.04, 0.95, -5.0], [4e-4, 2e-4, 1.0]])
    motion = translation(12, -7) if n == 1 else translation(12, -7) @ rolled(9, SHAPE) if n < 4 else bent
    [pair] = tied_pairs(read_ties(written(tmp_path / "ties.csv", motion, n), INFO), GROUPS, None)
    assert (pair.moving, pair.fixed) == (7, 1)
    np.testing.assert_allclose(pair.motion, motion, atol=1e-4)
    lost = Edge(7, 1, NotLocated("lost"))
    counted = pair.checked(lost)
    assert (counted.locator, counted.moving, counted.fixed) == (TIE, 7, 1)
    assert isinstance(counted.motion, Located)
    assert np.linalg.eigvalsh(counted.motion.information).min() > 0
    found = Edge(7, 1, Located(translation(3, 0) @ motion), "direct")
    assert pair.checked(found) is found
    assert pair.checked(Edge(7, 1, Located(translation(40, 0) @ motion), "direct")).locator == TIE


def test_points_follow_the_known_motion_to_the_instants_of_the_exposures(tmp_path: Path) -> None:
    known = KnownMotion(lambda frame: translation(0.05 * frame, 0))
    ties = read_ties(written(tmp_path / "ties.csv", translation(30, 0), 1, (110, 710)), INFO)
    [pair] = tied_pairs(ties, GROUPS, known)
    np.testing.assert_allclose(pair.motion, inverse(known.at([149.5])[0]) @ known.at([749.5])[0], atol=1e-9)


@pytest.mark.parametrize("n", [1, 3])
def test_contradictions_name_lines_and_px(tmp_path: Path, n: int) -> None:
    motion, everywhere = KnownMotion(lambda frame: translation(0.05 * frame, 0)), np.ones(10, dtype=bool)
    require_agreement(read_ties(written(tmp_path / "right.csv", translation(30, 0), n), INFO), GROUPS, everywhere, motion)
    file = written(tmp_path / "wrong.csv", translation(30, 0), n, wrong_px=-50)
    expected = (
        "line 2 contradicts the motion that fits all pairs best by 50 px; correct it, or remove it; if exposures are "
        "registered wrongly with each other, leave these out with graph.exclude"
    )
    if n == 3:
        expected = (
            "lines 2 and 4 contradict each other by 50 px, by the motion that fits all pairs best; correct the wrong one, "
            "or remove it"
        )
    with pytest.raises(InputError) as caught:
        require_agreement(read_ties(file, INFO), GROUPS, everywhere, motion)
    assert str(caught.value) == f"{file}: {expected}"
