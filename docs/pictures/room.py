"""The picture of a room: a frame, an average, the same moment merged through depth, and the paths that were found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from picture_parts import GAP, beside, drawn, labelled, stacked

from photonpano import evaluate_poses, load_spec, open_source, parse_spec, run
from photonpano.captures.writing import truth_path, write_packed
from photonpano.evaluation.poses import align_positions
from photonpano.poses import centres

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

CAPTURE = Path(__file__).parents[2] / "examples" / "pipelines" / "room-capture.yaml"
GROUP_SIZE, FOCAL_PX, FIRST = 30, 160, 300
"""Frames of an average, the focal length of the capture, and the first frame of the exposures that are shown."""
ESTIMATORS: dict[str, tuple[str, dict[str, Any]]] = {
    "colmap-averages": ("tab:orange", {"group_size": GROUP_SIZE}),
    "stratified-pose": ("tab:blue", {"group_size": GROUP_SIZE}),
}
"""Pose estimators, with the colours of their lines and their keys."""
MAGNIFIED = 1.7


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    yield "room.png", room(folder / "room")


def room(folder: Path) -> Picture:
    """Return the picture of the room, and print the scores of both estimators; what the folder holds is used again."""
    cube = folder / "room.npy"
    if not cube.exists():
        with open_source(load_spec(CAPTURE)) as source:
            write_packed(source, cube)
    for name, (_, keys) in ESTIMATORS.items():
        spec = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(cube.absolute()), "frame_rate_hz": 1000}},
            "pose": {"use": name, "with": keys},
            "camera": {"focal_px": FOCAL_PX},
            "output": {"exposures": True},
        }
        if not (folder / name / "run.json").exists():
            run(parse_spec(spec, output=folder / name))
        score = evaluate_poses(folder / name, truth_path(cube))
        print(f"{name:16} ATE {100 * score.ate_share:.3f} % of the path, rotation {score.rotation_deg:.3f} degrees")
    frame = np.unpackbits(np.load(cube, mmap_mode="r")[FIRST], axis=-1) * np.uint8(255)
    exposures = [
        cv2.imread(str(folder / name / "images" / f"exposure_{FIRST}.png"), cv2.IMREAD_GRAYSCALE) for name in ESTIMATORS
    ]
    labels = "one frame", f"{GROUP_SIZE} frames, averaged", "the same, merged through depth"
    above = beside(
        [
            labelled(cv2.resize(each, None, fx=MAGNIFIED, fy=MAGNIFIED, interpolation=cv2.INTER_AREA), label)
            for each, label in zip((frame, *exposures), labels, strict=True)
        ]
    )
    colours = np.repeat(above[:, :, None], 3, axis=2)
    below = paths(folder, cube, above.shape[1])
    gap = np.full((GAP, above.shape[1], 3), 255, np.uint8)
    return stacked([colours, gap, below])


def paths(folder: Path, cube: Path, width: int) -> Picture:
    """Return a plot of the true path and of those that were found, from above and from the side, of a width in px."""
    with np.load(truth_path(cube)) as file:
        true = centres(file["camera_from_world"])
    figure = Figure(figsize=(width / 100, 3.4), dpi=100, layout="constrained")
    panels = figure.subplots(1, 2)
    for panel, (along, up), labels in zip(panels, ((0, 2), (0, 1)), (("x (m)", "z (m)"), ("x (m)", "y (m)")), strict=True):
        panel.plot(true[:, along], true[:, up], color="black", linewidth=3, alpha=0.25, label="truth")
        for name, (colour, _) in ESTIMATORS.items():
            found = centres(np.load(folder / name / "poses.npz")["camera_from_world"])
            scale, rotation, shift = align_positions(found, true)
            aligned = scale * found @ rotation.T + shift
            panel.plot(aligned[:, along], aligned[:, up], color=colour, linewidth=1.2, label=name)
        panel.set_aspect("equal", adjustable="datalim")
        panel.set_xlabel(labels[0])
        panel.set_ylabel(labels[1])
    panels[1].invert_yaxis()
    panels[0].set_title("from above", fontsize=10)
    panels[1].set_title("from behind", fontsize=10)
    panels[0].legend(frameon=False, fontsize=9)
    return drawn(figure)[..., 2::-1]
