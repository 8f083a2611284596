"""Resolve the sections of a spec that choose components: each names one with `use`, and has its keys under `with`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from photonpano.contributions import ExporterContribution
from photonpano.errors import PluginError, described
from photonpano.interrupts import is_interrupt
from photonpano.registry.kinds import KINDS
from photonpano.specs.aliases import Alias
from photonpano.specs.plan import Choice
from photonpano.specs.validation import validate
from photonpano.specs.written import WrittenSpec, given
from photonpano.text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from photonpano.registry import Entry, Kind

DEFAULTS = {
    "resample": "midpoint",
    "merge": "photon-mle",
    "locate": "direct",
    "interpolate": "smoothing-spline",
    "render": "merge",
}
"""The components that a spec uses by default."""
DEFAULT_FALLBACK = "opencv-sift"
"""The locator to which lost pairs are offered, if it is installed and the spec names neither a locator nor fallbacks."""
DEFAULT_REFINER = "short-spans"
"""The refiner that corrects the motion, if it is installed and the spec names none."""
KIND_OF = {kind.section: kind for kind in KINDS.values()}
"""The kind of component that a section chooses."""
MAX_LISTED = 16
"""The largest number of components in a list, such as fallbacks."""
CHOICE = ("use", "with")
"""The keys that choose a component."""
_AGAIN = "would lose the same pairs again"


@dataclass(frozen=True, slots=True)
class Stage:
    """A section that chooses a component.

    Attributes:
        section: its keys `use`, `with` and `fallback`, with aliases and defaults spelled out; None if they cannot be.
        choice: the component; None if there are problems.
        fallbacks: the locators to which lost pairs are offered.
    """

    section: dict[str, Any] | None = None
    choice: Choice | None = None
    fallbacks: tuple[Choice, ...] = ()


class ComponentResolver:
    """Resolves the components of one spec; every method adds the problems that it finds to the spec, and goes on."""

    def __init__(self, spec: WrittenSpec) -> None:
        self.spec = spec
        self.catalog = spec.catalog

    def stage(self, name: str, data: Any, where: str, base: Stage | None = None) -> Stage:
        """Resolve a section that chooses a component.

        Args:
            name: such as "locate".
            data: the section.
            where: its path.
            base: for a section of a level, that of all levels: without `use`, the section updates the keys of this.
        """
        spec = self.spec
        content = spec.mapping(data, where, " such as {use: NAME}")
        if content is None:
            return Stage()
        if "use" in content:
            base = None
        section = self.spelled_out(name, content, where, base)
        if section is None:
            return Stage()
        n_problems = len(spec.problems)
        choice = self.component(KIND_OF[name], section, where)
        fallbacks = self.fallbacks(section["fallback"], where, choice) if name == "locate" else ()
        if base is not None:  # a problem of the base is reported again only for a key that the level itself writes
            old, new = spec.problems[:n_problems], spec.problems[n_problems:]
            reported = {(each.where.removeprefix(name), each.message) for each in old}
            own = spec.places.keys() - {f"{where}.with"}
            spec.problems = old + [x for x in new if x.where in own or (x.where.removeprefix(where), x.message) not in reported]
        return Stage(section, choice, fallbacks)

    def renderer(self, data: Any) -> Choice | None:
        """Resolve the component that `render` chooses, whose keys `use` and `with` stand beside the framework's."""
        if data is not None and not isinstance(data, dict):
            return None  # reported with the settings of the section
        chosen = {"use": DEFAULTS["render"]} | {key: value for key, value in (data or {}).items() if key in CHOICE}
        return self.component(KIND_OF["render"], chosen, "render")

    def executor(self, data: Any) -> Choice | None:
        """Resolve the executor, a key of the section `run`; None for threads, without a plugin."""
        written = data.get("executor") if isinstance(data, dict) else None
        return None if written is None else self.item(KIND_OF["run.executor"], written, "run.executor")

    def formats(self, data: Any) -> tuple[Choice, ...]:
        """Resolve the exporters; two of them cannot write the same file."""
        where, found = "output.formats", dict[str, Choice]()
        for index, item in enumerate(self.items(KIND_OF[where], data, where, None)):
            choice = self.item(KIND_OF[where], item, f"{where}.{index}")
            if choice is None:
                continue
            assert isinstance(choice.contribution, ExporterContribution)
            name, suffix = choice.contribution.name, choice.contribution.suffix
            if suffix in found:
                other = found[suffix].contribution.name
                self.spec.wrong_key(
                    f"{where}.{index}", f"{name!r} writes panorama{suffix}, as {other!r} does; keep one of them"
                )
            found.setdefault(suffix, choice)
        return tuple(found.values())

    def spelled_out(self, name: str, content: dict[str, Any], where: str, base: Stage | None) -> dict[str, Any] | None:
        """Return a section with inherited keys, defaults and aliases filled in, and a list of fallbacks; None if that fails."""
        spec, kind = self.spec, KIND_OF[name]
        section = dict(content)
        if base is not None:
            if base.section is None:
                return None
            own = {key: value for key, value in content.items() if value is not None}
            section = base.section | own | {"with": _updated(base.section.get("with"), content.get("with"))}
            for key in {"use", "with", "fallback"} - (own.keys() - {"with"}):
                spec.places = spec.places_under(f"{name}.{key}", f"{where}.{key}") | spec.places
        elif "use" not in content and name in DEFAULTS:
            section["use"] = DEFAULTS[name]
        known = ("use", "with", "fallback") if name == "locate" else ("use", "with")
        spec.check_keys(content, where, known, below=self.keys_of(kind, section.get("use")))
        if alias := self.alias(kind, section.get("use")):
            expanded = alias.expand(section, where, spec)
            if expanded is None:
                return None
            section = expanded
        if name == "locate":
            default = None if "use" in content else DEFAULT_FALLBACK
            section["fallback"] = self.items(kind, section.get("fallback"), f"{where}.fallback", default)
        return section

    def items(self, kind: Kind, data: Any, where: str, default: str | None) -> list[Any]:
        """Return what is written in a list of components; one alone is a list of it.

        Args:
            kind: the kind of the components.
            data: the list; None stands for the default.
            where: its path.
            default: the component that is chosen if it is installed and nothing is written.
        """
        if data is None:
            return [default] if default in self.catalog.names(kind.name) else []
        if isinstance(data, list):
            if len(data) > MAX_LISTED:
                self.spec.wrong(where, f"expected at most {MAX_LISTED} {kind.name}s, got {given(data)}")
            return data[:MAX_LISTED]
        self.spec.places = self.spec.places_under(where, f"{where}.0") | self.spec.places
        return [data]

    def fallbacks(self, items: list[Any], where: str, first: Choice | None) -> tuple[Choice, ...]:
        """Resolve the locators to which the pairs that the first one lost are offered."""
        found: list[Choice] = []
        for index, item in enumerate(items):
            path = f"{where}.fallback.{index}"
            choice = self.item(KIND_OF["locate"], item, path)
            if choice is None:
                continue
            name, is_own = choice.contribution.name, self.spec.place(path).where.startswith(where)
            if choice == first and not is_own:  # it became the same by what a level changes
                self.spec.wrong_key(where, f"the fallback {name!r} has the same keys, and {_AGAIN}")
            elif choice in (first, *found):
                self.spec.wrong_key(path, f"{name!r} with the same keys is tried before, and {_AGAIN}")
            else:
                found.append(choice)
        return tuple(found)

    def item(self, kind: Kind, item: Any, where: str) -> Choice | None:
        """Resolve one component of a list: a name, or a mapping."""
        spec = self.spec
        if isinstance(item, str):
            item = {"use": item}
            if where in spec.places:
                spec.places = {f"{where}.use": spec.places[where]} | spec.places
        if not isinstance(item, dict):
            article = "an" if kind.name[0] in "aeiou" else "a"
            expected = f"the name of {article} {kind.name}, or a mapping such as {{use: NAME}}"
            spec.wrong(where, f"expected {expected}, got {given(item)}")
            return None
        known = ["use", "with"]
        if kind is KIND_OF["locate"] and "fallback" in item:
            known.append("fallback")
            message = "a fallback cannot have a fallback; list all of them, in the order in which they are tried"
            spec.wrong_key(f"{where}.fallback", message)
        spec.check_keys(item, where, known, below=self.keys_of(kind, item.get("use")))
        return self.component(kind, item, where)

    def component(self, kind: Kind, section: dict[str, Any], where: str) -> Choice | None:
        """Look up the component that a section names, and validate its keys."""
        entry = self.entry(kind, section, where)
        if entry is None:
            return None
        try:
            config = validate(entry.contribution.config, section.get("with"), f"{where}.with", self.spec)
            if config is not None:
                config.model_dump(mode="json")  # a run records it
        except BaseException as error:
            if is_interrupt(error):
                raise
            self.spec.wrong_key(f"{where}.with", f"the config of the {entry.label} raised {described(error)}")
            return None
        return None if config is None else Choice(entry.contribution, config, entry.origin)

    def entry(self, kind: Kind, section: dict[str, Any], where: str) -> Entry | None:
        """Look up the component that a section names; None if it names none, or one that there is not."""
        use = section.get("use")
        if "use" not in section:
            known = (name for name in self.catalog.names(kind.name) if kind.name == "source" or not self.alias(kind, name))
            self.spec.wrong_key(f"{where}.use", f"required: the name of the {kind.name}; known: {listed(known) or 'none'}")
            return None
        if not isinstance(use, str):
            self.spec.wrong(f"{where}.use", f"expected the name of the {kind.name}, got {given(use)}")
            return None
        try:
            entry = self.catalog.find(kind.name, use)
        except PluginError as error:
            self.spec.wrong(f"{where}.use", str(error))
            return None
        if isinstance(entry.contribution, Alias):  # one that stands where it may has been spelled out
            message = f"{use!r} cannot be part of a chain or a fallback; list the {kind.name}s themselves"
            self.spec.wrong_key(where, message)
            return None
        if entry.unavailable:
            self.spec.wrong(f"{where}.use", entry.unavailable)
        return entry

    def keys_of(self, kind: Kind, name: object) -> Iterable[str]:
        """Return the keys of the component with this name; none if there is no such component."""
        return next((each.contribution.config.model_fields for each in self.catalog.entries(kind.name, name)), ())

    def alias(self, kind: Kind, name: object) -> Alias | None:
        """Return the alias with this name, None if there is none."""
        offered = (entry.contribution for entry in self.catalog.entries(kind.name, name))
        return next((each for each in offered if isinstance(each, Alias)), None)


def _updated(base: Any, keys: Any) -> Any:
    """Lay the keys of a level over those that it goes on from."""
    if isinstance(base, dict) and isinstance(keys, dict):
        return base | keys
    return base if keys is None else keys


def written_formats(root: dict[str, Any]) -> Any:
    """Return what is written under `output.formats`; None if there is nothing."""
    output = root.get("output")
    return output.get("formats") if isinstance(output, dict) else None
