"""photonpano explain."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from photonpano.cli.arguments import Overrides, Spec

if TYPE_CHECKING:
    from photonpano.protocols import Source
    from photonpano.registry import Catalog
    from photonpano.specs import Plan

FORETOLD = 3
"""How many levels are described of a plan whose number of levels is open."""


def explain(
    spec: Spec,
    overrides: Overrides = None,
    forecast: Annotated[
        bool, typer.Option("--forecast", help="Try the middle of the capture, and predict time and memory of the run.")
    ] = False,
) -> None:
    """Print a spec as it will run, with all defaults.

    The output is a spec itself. Its comments say which plugin gives each stage, what is a default, and how many groups and
    pairs each level will have.

    Example: photonpano explain scan.yaml > resolved.yaml
    """
    from photonpano.cli.wording import capture_words
    from photonpano.motion.pairs import pairs_of
    from photonpano.pipeline.components import foreseen_groups, open_source, scale_of
    from photonpano.registry import discover
    from photonpano.specs import load_spec

    catalog = discover()
    plan = load_spec(spec, overrides or (), catalog=catalog)
    predictions = []
    with open_source(plan) as source:
        capture = capture_words(source.info)
        for number, groups in enumerate(foreseen_groups(plan, source), start=1):
            scale = f"at scale {scale_of(plan, number, source.info.frame_shape):g}"
            if isinstance(groups, str):
                predictions.append(f"level {number}: groups are {groups}; {scale}")
                continue
            sizes = sorted({len(group.span) for group in groups})
            frames = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
            pairs = len(pairs_of(groups, plan.graph.skips))
            predictions.append(f"level {number}: {len(groups)} groups of {frames} frames, {pairs} pairs, {scale}")
        expected = _forecast(plan, source) if forecast else []
    if plan.until_converged:
        predictions = [f"up to {len(plan.levels)} levels, until the motion has settled", *predictions[:FORETOLD]]
        predictions.append("each further level: about twice the groups and pairs of the one before")
    typer.echo(f"# {spec} as it will run, on {capture}")
    typer.echo("\n".join(_Writer(plan, catalog, predictions).lines()))
    for line in expected:
        typer.echo(f"# {line}")


def _forecast(plan: "Plan", source: "Source") -> list[str]:
    """Return what a run is expected to take, or why the trial failed."""
    from photonpano.errors import PhotonpanoError
    from photonpano.pipeline.forecast import forecast
    from photonpano.report.numbers import duration, memory

    try:
        found = forecast(plan, source)
    except PhotonpanoError as error:
        return ["the trial in the middle of the capture failed, as the run may:", *str(error).splitlines()]
    threads = "1 thread" if found.threads == 1 else f"{found.threads} threads"
    each = ", ".join(f"{name}: {duration(seconds)}" for name, seconds in found.seconds.items())
    height, width = found.canvas
    return [
        f"forecast from a trial on {found.tried}: about {duration(sum(found.seconds.values()))} with {threads} ({each})",
        f"memory: about {memory(found.memory_bytes)}, for a panorama of about {width} x {height} px if no place is seen twice",
    ]


class _Writer:
    """Writes a resolved spec as YAML with comments."""

    def __init__(self, plan: "Plan", catalog: "Catalog", predictions: Sequence[str]) -> None:
        self._plan = plan
        self._catalog = catalog
        self._predictions = predictions

    def lines(self) -> Iterator[str]:
        """Yield the lines of the whole spec."""
        for section, value in self._plan.document.items():
            if section == "levels" and self._plan.until_converged:
                yield from (f"# {comment}" for comment in self._predictions)
                yield from self._mapping({section: value}, "", "")
            elif section == "levels":
                yield "levels:"
                for index, (level, comment) in enumerate(zip(value, self._predictions, strict=True)):
                    yield f"  # {comment}"
                    yield from self._item(level, f"levels.{index}", "  ")
            else:
                yield from self._mapping({section: value}, "", "")

    def _mapping(self, mapping: Mapping[str, Any], where: str, indent: str) -> Iterator[str]:
        from photonpano.registry.description import flow
        from photonpano.specs.tree import joined

        for key, value in mapping.items():
            path = joined(where, key)
            if isinstance(value, dict) and value:
                yield f"{indent}{key}:"
                yield from self._mapping(value, path, f"{indent}  ")
            elif value and re.fullmatch(r"corrections|(levels\.\d+\.)?locate\.fallback", path):
                yield f"{indent}{key}:"
                for index, item in enumerate(value):
                    yield from self._item(item, f"{path}.{index}", f"{indent}  ")
            else:
                remarks = [self._origin(path, value), self._written(path)]
                comment = ", ".join(filter(None, remarks))
                yield f"{indent}{key}: {flow(value)}" + (f"  # {comment}" if comment else "")

    def _item(self, item: Mapping[str, Any] | str, where: str, indent: str) -> Iterator[str]:
        first, *others = [item] if isinstance(item, str) else self._mapping(item, where, "")
        yield f"{indent}- {first}"
        yield from (f"{indent}  {line}" for line in others)

    def _origin(self, path: str, value: Any) -> str:
        """Say which plugin gives a component, and why it was chosen where the spec leaves that open."""
        from photonpano.registry import KINDS

        *_, section, key = ["", *re.sub(r"\.fallback\.\d+", "", path).split(".")]
        kinds = [kind.name for kind in KINDS.values() if kind.section == section]
        if key != "use" or not kinds:
            return ""
        entry = self._catalog.find(kinds[0], value)
        reasons = [decision.reason for decision in self._plan.decisions if decision.what == path.removesuffix(".use")]
        return ", ".join([f"{entry.origin.plugin} {entry.origin.version}", *reasons])

    def _written(self, path: str) -> str:
        """Say where a value comes from, unless it stands in the file as it is."""
        places = self._plan.places
        place = places.get(path)
        if place is None and path.startswith("levels."):
            _, index, stage, *rest = path.split(".")
            # A level that does not choose another component goes on from the keys and the fallback of the stage.
            own = f"levels.{index}.{stage}"
            replaced = f"{own}.use" in places or (rest[:1] == ["fallback"] and f"{own}.fallback.0" in places)
            if rest and not replaced:
                place = places.get(".".join([stage, *rest]))
        if place is not None and place.override is not None:
            return "--set"
        return "default" if place is None or place.line is None else ""
