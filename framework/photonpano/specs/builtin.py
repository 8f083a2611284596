"""The contributions of the framework, which enter by the entry point `framework`; and checks that single sections cannot do."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from heapq import nsmallest
from itertools import islice
from typing import Any, NoReturn

from pydantic import ConfigDict, Field

from photonpano.corrections import Correction, FlatField
from photonpano.errors import InputError, PluginError, Problem, described
from photonpano.files.paths import Location, Url
from photonpano.plugins.contributions import Config, MergerContribution, Recognised, SourceContribution, SpecLocation, hookimpl
from photonpano.plugins.registry import Catalog, Entry
from photonpano.reading import objections, require_there
from photonpano.specs.plan import Choice, LevelPlan, Plan, Spec, validate
from photonpano.specs.settings import CameraSettings, MotionSettings
from photonpano.specs.yaml_reader import Written, from_python
from photonpano.text import listed
from photonpano.values import Decision, StreamInfo

logger = logging.getLogger(__name__)

_SHOWN = 3  # names of a folder in a message
_SEARCHED = 1000  # maximum number of files of a folder whose endings are compared with those of sources


def check_stream(plan: Plan, info: StreamInfo) -> list[Problem]:
    """Check a plan against its capture: all stages, refiners and the renderer, and the frames of the panorama.

    Reads no data. What levels share is reported once, and each problem at its place in the spec.
    """
    choices = [] if plan.finder is None else [plan.finder]
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
        from photonpano.motion.gyroscope import read_rates  # with numba

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
        return (found,) if isinstance(found, str) else tuple(map(str, found))
    except Exception as error:
        return (f"the check of the {choice.label} raised {described(error)}",)


_TURNING = ("rotation", "auto")  # the models that may find that a camera turns


def check_settings(found: dict[str, Any], spec: Spec) -> None:
    """Check the settings of each section, None where they have problems, against each other; problems go to the spec."""
    motion, camera, output, render = (found[name] for name in ("motion", "camera", "output", "render"))
    if motion is not None and camera is not None:
        _check_camera(motion, camera, spec)
    if output is not None and output.exposures and spec.kind is None:
        sections = listed((f"`{section}`" for section in spec.catalog.run_kinds), "or") or "of a plugin"
        message = f"true needs a section {sections}: of a panorama, keep: exposures writes them; remove it"
        spec.wrong(spec.root.at("output", "exposures"), message)
    if (
        motion is not None
        and render is not None
        and motion.model not in _TURNING
        and render.projection not in ("auto", "planar")
    ):
        message = f"a {render.projection} panorama needs motion.model: rotation or auto; that of {motion.model} is planar"
        spec.wrong(spec.root.at("render", "projection"), message)


def _check_camera(motion: MotionSettings, camera: CameraSettings, spec: Spec) -> None:
    """Refuse what planar models and other kinds of runs cannot find of the camera, and a start that rotations do not have."""
    if motion.model == "rotation" and motion.start != "none":
        message = f"{motion.start} is a start of planar models, not of motion.model: rotation"
        spec.wrong(spec.root.at("motion", "start"), message)
    if motion.prior is not None and (motion.model != "rotation" or camera.focal_px == "find"):
        message = "a gyroscope needs motion.model: rotation, and the focal length of the camera: give camera.focal_px"
        spec.wrong(spec.root.at("motion", "prior"), message)
    elif motion.prior is not None and not motion.prior.imu.is_file():
        spec.wrong(spec.root.at("motion", "prior", "imu"), f"there is no file {motion.prior.imu}; check the path")
    if motion.model in _TURNING and spec.kind is None:
        return
    unfindable = "find needs motion.model: rotation or auto, which measure the camera; give a number here"
    without_focal = "distortion is in units of the focal length: give camera.focal_px"
    if spec.kind is not None:
        instead = "calibrate the lens, or measure it in a run with motion.model: rotation"
        unfindable = f"find does not apply with `{spec.kind.section}`: {instead}"
    else:
        without_focal += ", or take motion.model: rotation or auto"
    distortion, written = camera.distortion.model_dump(), spec.root.at("camera", "distortion")
    for key, number in distortion.items():
        if number == "find":
            spec.wrong(written.at(key), unfindable)
    known = (number for number in distortion.values() if spec.kind is None or number != "find")
    if camera.focal_px == "find" and any(known):
        spec.wrong_key(written, without_focal)


def check_flat_field(corrections: Iterable[Correction], levels: Iterable[LevelPlan], spec: Spec) -> None:
    """Refuse a flat field where nothing can be divided by it."""
    index = next((place for place, each in enumerate(corrections) if isinstance(each, FlatField)), None)
    if index is None:
        return
    mergers = [level.merge.contribution for level in levels]
    refusing = [each.name for each in mergers if isinstance(each, MergerContribution) and not each.accepts_corrected_sums]
    written = spec.root.at("corrections", index)
    if spec.kind is not None:
        spec.wrong(written, f"flat-field does not apply with `{spec.kind.section}`: it is measured along a panorama; remove it")
    elif refusing:
        message = f"flat-field divides sums of frames, and {refusing[0]!r} merges single frames; choose another merger"
        spec.wrong(written, message)


class AutoConfig(Config):
    """A capture of any kind."""

    # For editors: the other keys are those of the source that recognises the path.
    model_config = ConfigDict(json_schema_extra={"additionalProperties": True})

    path: SpecLocation = Field(
        description="the file or folder, or its URL; other keys are passed to the source that recognises it"
    )


RECOGNISED = "auto"  # stands for the source that recognises a capture


def _unbuilt(*_: object) -> NoReturn:
    raise PluginError("this name stands for another source, to which a spec that uses it is resolved; build that")


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer the name for the source that recognises a capture."""
    yield SourceContribution(
        name=RECOGNISED, summary="The source that recognises the file or folder", config=AutoConfig, build=_unbuilt
    )


def recognised_source(section: Written, spec: Spec) -> Written | None:
    """Rewrite a section that uses `auto` into one that uses the source that recognises the capture.

    The keys that the source recognised are laid under those that are written beside the path.
    """
    keys = section.at("with")
    config = validate(AutoConfig, keys.only(AutoConfig.model_fields), spec)
    if config is None:
        return None
    path, written = config.path, keys.at("path")
    if unreadable := objections(require_there, path):
        spec.wrong(written, unreadable[0])
        return None
    recognised, failures = ask_sources(spec.catalog, path)
    if len(recognised) != 1:
        several = [f"{entry.name} ({answer.because})" for entry, answer in recognised]
        if several:
            message = f"{path} is recognised by {listed(several)}; name the right one"
        else:
            # The path is named once; each line begins with its last part.
            near = _near_misses(spec, keys, path)
            lines = [f"{name}: {line.replace(str(path), path.name or str(path), 1)}" for name, line in near]
            endings = f"the names of files of captures end in {listed(known_endings(spec.catalog))}"
            lines = [*(lines or [endings]), *failures]
            message = "\n  ".join([f"no source recognises {path}, {_contents(path)}; name the one that reads it", *lines])
            if isinstance(path, Url) and len({line for _, line in near}) == 1:  # such as that there is nothing
                message = near[0][1]
        spec.wrong(written, message)
        return None
    for failure in failures:
        logger.warning(failure)
    ((entry, answer),) = recognised
    found = from_python(answer.keys, replace(written.place, where=keys.place.where), spec.problems)
    spec.remark = f" ({path.name} was recognised as {entry.name}: {answer.because})"
    reason = f"{path.name} was recognised: {answer.because}"
    spec.recognised = Decision(section.place.where, entry.name, reason)
    together = Written(found.data | keys.without(*AutoConfig.model_fields).data, keys.place)
    return section.having({"use": Written(entry.name, section.at("use").place), "with": together})


def ask_sources(catalog: Catalog, path: Location) -> tuple[list[tuple[Entry, Recognised]], list[str]]:
    """Show a path to all sources: return those that recognise it, and a clause for each that raised or broke its contract."""
    recognised: list[tuple[Entry, Recognised]] = []
    failures: list[str] = []
    for entry in catalog.rows:
        if not isinstance(entry.contribution, SourceContribution):
            continue
        if isinstance(path, Url) and not entry.contribution.recognises_urls:
            continue
        try:
            answer = entry.contribution.recognise(path)
        except Exception as error:
            failures.append(f"recognise of the {entry.label} raised {described(error)}")
            continue
        returned = f"recognise of the {entry.label} returned"
        if not isinstance(answer, Recognised | None):
            failures.append(f"{returned} a {type(answer).__name__}, expected a Recognised or None")
        elif answer and not isinstance(answer.keys, Mapping):
            failures.append(f"{returned} keys of type {type(answer.keys).__name__}, expected a mapping")
        elif answer:
            recognised.append((entry, answer))
    return recognised, failures


def _near_misses(spec: Spec, keys: Written, path: Location) -> list[tuple[str, str]]:
    """Return the problems that sources have with a capture whose files end as theirs do, with the name of each source.

    Sources that accept the keys come first, then those that need others.
    """
    problems, needing = list[tuple[str, str]](), list[tuple[str, str]]()
    files = [path] if isinstance(path, Url) or path.is_file() else islice(path.rglob("*"), _SEARCHED)
    endings = {path.suffix.lower(), *(each.suffix.lower() for each in files)}
    for entry in spec.catalog.rows:
        contribution = entry.contribution
        if not isinstance(contribution, SourceContribution) or entry.name == RECOGNISED:
            continue
        if contribution.suffixes and not endings & {*contribution.suffixes}:
            continue
        if isinstance(path, Url) and not contribution.recognises_urls:
            continue
        needed = [name for name, field in contribution.config.model_fields.items() if field.is_required()]
        if contribution.suffixes and (missing := [name for name in needed if keys.at(name).data is None]):
            needing.append((entry.name, f"reads such files if the source is named, with {listed(missing)} beside the path"))
            continue
        try:
            config = validate(contribution.config, keys, replace(spec, problems=[]))
        except Exception:  # what is wrong with the config is reported once the source is named
            config = None
        if config is not None:
            problems += ((entry.name, each) for each in complaints(Choice(contribution, config, entry.origin)))
    return problems + needing


def known_endings(catalog: Catalog) -> list[str]:
    """Return the endings of the files of all sources."""
    sources = [each.contribution for each in catalog.rows if isinstance(each.contribution, SourceContribution)]
    return sorted({suffix for source in sources for suffix in source.suffixes})


def _contents(path: Location) -> str:
    """Describe a file or folder that no source recognises."""
    if isinstance(path, Url):
        return "a URL"
    if path.is_file():
        return f"a file of {path.stat().st_size:,} bytes"
    try:
        names = nsmallest(_SHOWN + 1, (each.name for each in path.iterdir()))
    except OSError as error:
        return f"which cannot be read ({error.strerror})"
    if len(names) > _SHOWN:
        return f"a folder of {', '.join(names[:_SHOWN])} and more"
    return f"a folder of {listed(names)}" if names else "an empty folder"
