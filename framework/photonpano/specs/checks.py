"""Check what single sections cannot: settings against each other, and components against the capture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import islice
from typing import Any

from photonpano.corrections import Correction, FlatField
from photonpano.errors import InputError, Problem, described
from photonpano.motion.gyroscope import read_rates
from photonpano.plugins.contributions import MergerContribution
from photonpano.specs.plan import Choice, LevelPlan, Plan
from photonpano.specs.settings import CameraSettings, MotionSettings
from photonpano.specs.spec import Spec
from photonpano.values import StreamInfo

MAX_COMPLAINTS = 100  # of one component that are reported


def check_stream(plan: Plan, info: StreamInfo) -> list[Problem]:
    """Check a plan against its capture: all stages, refiners and the renderer, and the frames of the panorama.

    Reads no data. What levels share is reported once, and each problem at its place in the spec.
    """
    choices = [] if plan.pose is None else [plan.pose]
    for level in plan.levels:
        choices += [level.resample, level.merge, level.locate, level.interpolate, *level.fallbacks]
    found: dict[tuple[str, str], Problem] = {}
    for choice in (*choices, *plan.refine, plan.renderer, *plan.formats):
        for sentence in complaints(choice, info):
            found.setdefault((choice.contribution.name, sentence), choice.place.problem(sentence))
    problems = list(found.values())
    for key in ("reference", "movers"):
        frame = getattr(plan.render, key)
        if isinstance(frame, int) and frame >= info.n_frames:
            message = f"expected a frame of the capture, 0 to {info.n_frames - 1}, got {frame}"
            problems.append(plan.place(f"render.{key}").problem(message))
    outside = [frame for pair in plan.graph.exclude for frame in pair if frame >= info.n_frames]
    if outside:
        message = f"expected frames of the capture, 0 to {info.n_frames - 1}, got {outside[0]}"
        problems.append(plan.place("graph.exclude").problem(message))
    files: dict[str, Callable[[], object]] = {}
    if plan.graph.tie is not None:
        from photonpano.motion.pairs import read_ties  # with OpenCV, which other specs need not import

        files["graph.tie"] = partial(read_ties, plan.graph.tie, info)
    if plan.motion.prior is not None:
        files["motion.prior.imu"] = partial(read_rates, plan.motion.prior.imu)
    for key, read in files.items():
        try:
            read()
        except InputError as error:
            problems.append(plan.place(key).problem(str(error)))
    return problems


def complaints(choice: Choice, *stream: StreamInfo) -> tuple[str, ...]:
    """Run the `check` of a component; one that raises is a complaint itself."""
    try:
        found = choice.contribution.check(choice.config, *stream)
        return (found,) if isinstance(found, str) else tuple(map(str, islice(found, MAX_COMPLAINTS)))
    except Exception as error:
        return (f"the check of the {choice.label} raised {described(error)}",)


_TURNING = ("rotation", "auto")  # the models that may find that a camera turns


def check_settings(found: dict[str, Any], posed: bool, spec: Spec) -> None:
    """Check the settings of each section, None where they have problems, against each other; problems go to the spec."""
    motion, camera, output, render, run = (found[name] for name in ("motion", "camera", "output", "render", "run"))
    if motion is not None and camera is not None:
        _check_camera(motion, camera, posed, spec)
    if output is not None and output.exposures and not posed:
        message = "true needs a section `pose`: a panorama has no exposures with poses; remove it"
        spec.wrong(spec.root.at("output", "exposures"), message)
    if output is not None and output.keep is not None and posed:
        message = "exposures are those of the levels of a panorama; remove it, or write exposures: true"
        spec.wrong(spec.root.at("output", "keep"), message)
    if run is not None and run.time_limit is not None and posed:
        spec.wrong(spec.root.at("run", "time_limit"), "a pose estimator cannot end early; remove it")
    if (
        motion is not None
        and render is not None
        and motion.model not in _TURNING
        and render.projection not in ("auto", "planar")
    ):
        message = f"a {render.projection} panorama needs motion.model: rotation or auto; that of {motion.model} is planar"
        spec.wrong(spec.root.at("render", "projection"), message)


def _check_camera(motion: MotionSettings, camera: CameraSettings, posed: bool, spec: Spec) -> None:
    """Refuse what planar models and pose estimators cannot find of the camera, and a start that rotations do not have."""
    if motion.model == "rotation" and motion.start != "none":
        message = f"{motion.start} is a start of planar models, not of motion.model: rotation"
        spec.wrong(spec.root.at("motion", "start"), message)
    if motion.prior is not None and (motion.model != "rotation" or camera.focal_px == "find"):
        message = "a gyroscope needs motion.model: rotation, and the focal length of the camera: give camera.focal_px"
        spec.wrong(spec.root.at("motion", "prior"), message)
    elif motion.prior is not None and not motion.prior.imu.is_file():
        spec.wrong(spec.root.at("motion", "prior", "imu"), f"there is no file {motion.prior.imu}; check the path")
    if motion.model in _TURNING and not posed:
        return
    unfindable = "find needs motion.model: rotation or auto, which measure the camera; give a number here"
    without_focal = "distortion is in units of the focal length: give camera.focal_px"
    if posed:
        unfindable = "find does not apply with `pose`: calibrate the lens, or measure it in a run with motion.model: rotation"
    else:
        without_focal += ", or take motion.model: rotation or auto"
    distortion, written = camera.distortion.model_dump(), spec.root.at("camera", "distortion")
    for key, number in distortion.items():
        if number == "find":
            spec.wrong(written.at(key), unfindable)
    if camera.focal_px == "find" and any(number != 0 and not (posed and number == "find") for number in distortion.values()):
        spec.wrong_key(written, without_focal)


def check_flat_field(corrections: Iterable[Correction], levels: Iterable[LevelPlan], posed: bool, spec: Spec) -> None:
    """Refuse a flat field where nothing can be divided by it."""
    index = next((place for place, each in enumerate(corrections) if isinstance(each, FlatField)), None)
    if index is None:
        return
    mergers = [level.merge.contribution for level in levels]
    refusing = [each.name for each in mergers if isinstance(each, MergerContribution) and not each.accepts_corrected_sums]
    written = spec.root.at("corrections", index)
    if posed:
        spec.wrong(written, "flat-field does not apply with `pose`: it is measured along a panorama; remove it")
    elif refusing:
        message = f"flat-field divides sums of frames, and {refusing[0]!r} merges single frames; choose another merger"
        spec.wrong(written, message)
