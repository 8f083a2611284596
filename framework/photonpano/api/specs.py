"""Look at specs: check one without running it, explain it with all defaults, and print their JSON Schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from photonpano.api.command import CHANGES, SPEC, command
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, PhotonpanoError
from photonpano.execution.context import Progress, Quiet, usual
from photonpano.files.folders import atomic_path, require_harmless, require_new
from photonpano.pipeline.components import foreseen_groups, open_source, scale_of
from photonpano.plugins.contributions import KINDS
from photonpano.plugins.description import flow
from photonpano.plugins.registry import Catalog, discover
from photonpano.record.contents import capture_files
from photonpano.specs import Plan, json_schema, load_spec
from photonpano.specs.yaml_reader import joined
from photonpano.text import byte_size, counted, duration

if TYPE_CHECKING:
    from photonpano.pipeline.forecast import Forecast  # imports numba, which only a forecast needs

_DESCRIBED_LEVELS = 3  # maximum number of levels described under `levels: until-converged`


@command("scan.yaml", lambda lines: lines, spec=SPEC, changes=CHANGES)
def _check(spec: Path, changes: Sequence[str] = ()) -> Iterator[str]:
    """Check a spec without running it.

    Prints every problem with its file, line and column, and exits with 2 if there is one. Opens the capture to check the
    stages against its size, and samples the frames of packed .npy files: what depends on all frames stays open.
    """
    plan = load_spec(spec, changes)
    require_harmless(plan.output.directory, capture_files(plan))
    with open_source(plan, look=False) as source:
        what = (
            f"{plan.kind.name} by {plan.finder.contribution.name}"
            if plan.kind and plan.finder
            else counted(len(plan.levels), "level")
        )
        up_to = "up to " if plan.until_converged else ""
        yield f"{spec}: ok, {up_to}{what} on {plan.source.contribution.name}: {source.info}"
        if (found := plan.recognised) is not None:
            yield f"{found.what} is {found.value}: {found.reason}"
        for reason in dict.fromkeys(groups for groups in foreseen_groups(plan, source) if isinstance(groups, str)):
            yield f"groups are {reason}"


def forecast(plan: Plan) -> Forecast:
    """Predict time and memory of a run, from a trial on the middle of the capture.

    Raises:
        InputError: the spec finds something else than a panorama.
        PhotonpanoError: the trial failed, as the run may.
    """
    from photonpano.pipeline.forecast import forecast as forecast_from

    _require_levels(plan)
    with open_source(plan) as source:
        return forecast_from(plan, source, Quiet())


@command(
    "scan.yaml > resolved.yaml",
    lambda text: [text.removesuffix("\n")],
    plan="spec",
    with_forecast=typer.Option("--forecast", help="Try the middle of the capture, and predict time and memory of the run."),
)
def explain(
    plan: Plan, *, with_forecast: bool = False, catalog: Catalog | None = None, progress: Progress | None = None
) -> str:
    """Write a spec with all defaults, explained in comments.

    The text is a spec itself. Its comments name the plugin of each component, the origin of each value that does not stand in
    the file, and the number of groups and pairs of each level.

    Args:
        plan: from `load_spec` or `parse_spec`.
        with_forecast: whether comments at the end give what `forecast` predicts, or why its trial failed.
        catalog: the catalog that the plan was made with; by default what the installed plugins offer.
        progress: receives the stages of the trial; by default, bars in a notebook and nothing elsewhere.

    Returns:
        YAML.

    Raises:
        InputError: the capture cannot be used as it is.
        SpecError: a stage does not suit it.
    """
    if with_forecast:
        _require_levels(plan)
    with open_source(plan, look=with_forecast) as source:
        title = f"# {plan.file or 'the spec'} as it will run, on {source.info}"
        writer = _Writer(plan, discover() if catalog is None else catalog, list(_levels(plan, source)))
        prediction = [f"# {line}" for line in _forecast_lines(plan, source, usual(progress))] if with_forecast else []
    return "\n".join([title, *writer.lines(), *prediction]) + "\n"


def _require_levels(plan: Plan) -> None:
    if plan.kind is not None:
        raise InputError(f"a forecast is of panoramas, and the spec finds {plan.kind.name}: leave out --forecast")


def _levels(plan: Plan, source: Source) -> Iterator[str]:
    """Yield a comment for each level; of an open number of levels, for all of them together."""
    from photonpano.motion.pairs import pairs_of  # imports OpenCV, which `check` does without

    if plan.until_converged:
        yield f"up to {len(plan.levels)} levels, until the motion has converged"
    for number, groups in enumerate(foreseen_groups(plan, source), start=1):
        if plan.until_converged and number > _DESCRIBED_LEVELS:
            yield "each further level: about twice the groups and pairs of the one before"
            return
        scale = f"at scale {scale_of(plan, number, source.info.frame_shape):g}"
        if isinstance(groups, str):
            yield f"level {number}: groups are {groups}; {scale}"
            continue
        sizes = sorted({len(group.span) for group in groups})
        frames = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
        pairs = len(pairs_of(groups, plan.graph.skips))
        yield f"level {number}: {len(groups)} groups of {frames} frames, {pairs} pairs, {scale}"


def _forecast_lines(plan: Plan, source: Source, progress: Progress) -> list[str]:
    from photonpano.pipeline.forecast import forecast as forecast_from

    try:
        found = forecast_from(plan, source, progress)
    except PhotonpanoError as error:
        return ["the trial in the middle of the capture failed, as the run may:", *str(error).splitlines()]
    each = ", ".join(f"{name}: {duration(seconds)}" for name, seconds in found.seconds.items())
    total, threads = duration(sum(found.seconds.values())), counted(found.threads, "thread")
    memory, (height, width) = byte_size(found.memory_bytes), found.canvas
    return [
        f"forecast from a trial on {found.tried}: about {total} with {threads} ({each})",
        f"memory: about {memory}, for a panorama of about {height}x{width} px if no place is seen twice",
    ]


class _Writer:
    """Writes a resolved spec as YAML with comments."""

    def __init__(self, plan: Plan, catalog: Catalog, levels: Sequence[str]) -> None:
        self._plan = plan
        self._catalog = catalog
        self._levels = levels

    def lines(self) -> Iterator[str]:
        for section, value in self._plan.document.items():
            if section == "levels" and self._plan.until_converged:
                yield from (f"# {comment}" for comment in self._levels)
                yield from self._mapping({section: value}, "", "")
            elif section == "levels":
                yield "levels:"
                for index, (level, comment) in enumerate(zip(value, self._levels, strict=True)):
                    yield f"  # {comment}"
                    yield from self._item(level, f"levels.{index}", "  ")
            else:
                yield from self._mapping({section: value}, "", "")

    def _mapping(self, mapping: Mapping[str, Any], where: str, indent: str) -> Iterator[str]:
        for key, value in mapping.items():
            path = joined(where, key)
            if isinstance(value, dict) and value:
                yield f"{indent}{key}:"
                yield from self._mapping(value, path, f"{indent}  ")
            elif (
                isinstance(value, list) and value and re.fullmatch(r"corrections|refine|(levels\.\d+\.)?locate\.fallback", path)
            ):
                yield f"{indent}{key}:"
                for index, item in enumerate(value):
                    yield from self._item(item, f"{path}.{index}", f"{indent}  ")
            else:
                comment = ", ".join(filter(None, [self._provider(path, value), self._origin(path)]))
                yield f"{indent}{key}: {flow(value)}" + (f"  # {comment}" if comment else "")

    def _item(self, item: Mapping[str, Any] | str, where: str, indent: str) -> Iterator[str]:
        first, *others = [item] if isinstance(item, str) else self._mapping(item, where, "")
        yield f"{indent}- {first}"
        yield from (f"{indent}  {line}" for line in others)

    def _provider(self, path: str, value: Any) -> str:
        """Return which plugin provides a component, and the reason if the spec left the choice open."""
        *_, section, key = ["", *re.sub(r"(\.fallback)?\.\d+", "", path).split(".")]
        kinds = [kind.name for kind in KINDS.values() if kind.section == section]
        if key != "use" or not kinds:
            return ""
        entry = self._catalog.find(kinds[0], value)
        chosen = self._plan.recognised if section == "source" else None
        return f"{entry.origin.plugin} {entry.origin.version}" + (f", {chosen.reason}" if chosen else "")

    def _origin(self, path: str) -> str:
        """Return "default" or "--set" for a value that does not stand in the file."""
        place = self._plan.place(path)
        if place.is_written and place.override is not None:
            return "--set"
        return "default" if not place.is_written or place.line is None else ""


@command("--output photonpano.schema.json", lambda line: [line], output=typer.Option("--output", "-o", metavar="FILE"))
def schema(output: Path | None = None, *, overwrite: bool = False) -> str:
    """Print the JSON Schema of specs, for editors.

    The schema holds the keys of all installed plugins. Editors with a YAML language server complete and check specs whose first
    line is '# yaml-language-server: $schema=FILE'.

    Args:
        output: write the schema to a file instead of printing it.
        overwrite: replace the file that is there under this name.
    """
    text = json.dumps(json_schema(discover()), indent=2, ensure_ascii=False)
    if output is None:
        return text
    require_new(output, overwrite)
    with atomic_path(output) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
    return str(output)
