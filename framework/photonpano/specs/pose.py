"""Check a spec with a section `pose`: its run finds the pose of every frame instead of a panorama."""

from __future__ import annotations

from typing import Any

from photonpano.specs.checks import STAGES
from photonpano.specs.components import written_formats
from photonpano.specs.settings import CameraSettings
from photonpano.specs.written import WrittenSpec

PANORAMA_ONLY = (*STAGES, "refine", "levels", "motion", "light", "graph", "render")
"""The sections that do not apply with `pose`."""


def without_panorama(root: dict[str, Any], spec: WrittenSpec) -> dict[str, Any]:
    """Refuse the sections that do not apply with `pose`, and return the others."""
    for key in PANORAMA_ONLY:
        if key in root:
            message = "does not apply with `pose`, which finds poses instead of a panorama; remove it, or remove `pose`"
            spec.wrong_key(key, message)
    if written_formats(root) is not None:
        message = "does not apply with `pose`: there is no panorama to write; `photonpano export` writes poses"
        spec.wrong_key("output.formats", message)
    own = {key: value for key, value in root.items() if key not in PANORAMA_ONLY}
    run = own.get("run")
    if isinstance(run, dict) and run.get("executor") is not None:
        spec.wrong_key("run.executor", "does not apply with `pose`: poses are found in threads of one process")
    output = own.get("output")
    if isinstance(output, dict):
        own["output"] = {key: value for key, value in output.items() if key != "formats"}
    return own


def document_of_poses(document: dict[str, Any]) -> dict[str, Any]:
    """Return a resolved spec without what does not apply with `pose`."""
    own = {key: value for key, value in document.items() if key not in PANORAMA_ONLY}
    return own | {"output": {key: value for key, value in document["output"].items() if key not in ("formats", "keep")}}


def check_posed_camera(camera: CameraSettings, spec: WrittenSpec) -> None:
    """Refuse a distortion that is to be found: pose estimators take it as it is given."""
    distortion = camera.distortion.model_dump()
    for key in (key for key, number in distortion.items() if number == "find"):
        message = "find does not apply with `pose`: calibrate the lens, or measure it in a run with motion.model: rotation"
        spec.wrong(f"camera.distortion.{key}", message)
    if camera.focal_px == "find" and any(number not in (0, "find") for number in distortion.values()):
        message = "distortion is in units of the focal length: give camera.focal_px"
        spec.wrong_key("camera.distortion", message)
