"""Resolve what a spec names: components by `use`, with their keys under `with`, and corrections by their names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonpano.corrections import CORRECTIONS, Correction
from photonpano.errors import PluginError, described
from photonpano.plugins.contributions import KINDS, ExporterContribution, Kind
from photonpano.plugins.registry import Entry
from photonpano.reading import missing_file
from photonpano.specs.builtin import RECOGNISED, recognised_source
from photonpano.specs.plan import Choice, Spec, validate
from photonpano.specs.settings import CHOICE
from photonpano.specs.yaml_reader import Written, given
from photonpano.text import listed, suggestion

# The locator to which lost pairs are offered, if it is installed and the spec names neither a locator nor fallbacks.
DEFAULT_FALLBACK = "opencv-sift"
_AGAIN = "would lose the same pairs again"
AUTO = "auto"  # the default: the run masks what stands still, and divides by a vignette
CHAIN = "chain-of-backends"  # another spelling of a locator with fallbacks


@dataclass(frozen=True, slots=True)
class Stage:
    """A section that chooses a component: with aliases and defaults spelled out, None if they cannot be; and the choices."""

    section: Written | None = None
    choice: Choice | None = None
    fallbacks: tuple[Choice, ...] = ()


class ComponentResolver:
    """Resolves the components of one spec; every method adds the problems that it finds to the spec, and goes on."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.catalog = spec.catalog

    def stage(self, kind: Kind, written: Written, base: Stage | None = None) -> Stage:
        """Resolve a section that chooses a component.

        `base` is, for a section of a level, that of all levels: without `use`, the section updates the keys of this.
        """
        spec = self.spec
        content = spec.mapping(written, " such as {use: NAME}")
        if content is None:
            return Stage()
        if "use" in content.data:
            base = None
        section = self.spelled_out(kind, content, base)
        if section is None:
            return Stage()
        n_problems = len(spec.problems)
        choice = self.component(kind, section)
        fallbacks = self.fallbacks(section, content, choice) if kind is KINDS["locator"] else ()
        if base is not None:  # a problem of the base is reported again only for a key that the level itself writes
            old, new = spec.problems[:n_problems], spec.problems[n_problems:]
            reported = {(each.where.removeprefix(kind.section), each.message) for each in old}
            own = {each.place.where for each in content.all()} - {content.at("with").place.where}
            where = content.place.where
            spec.problems = old + [x for x in new if x.where in own or (x.where.removeprefix(where), x.message) not in reported]
        return Stage(section, choice, fallbacks)

    def spelled_out(self, kind: Kind, content: Written, base: Stage | None) -> Written | None:
        """Return a section with inherited keys, defaults and aliases filled in, and a list of fallbacks; None if that fails."""
        spec, is_locator, section = self.spec, kind is KINDS["locator"], content
        if base is not None:
            if base.section is None:
                return None
            own = {key: value for key, value in content.data.items() if value.data is not None}
            together = content.at("with").laid_over(base.section.at("with"))
            section = Written(base.section.data | own | {"with": together}, content.place)
        elif "use" not in content.data and kind.default:
            section = content.having({"use": Written(kind.default, content.place.below("use"))})
        use = section.at("use").data
        below = ("backends",) if is_locator and use == CHAIN else self.catalog.keys_of(kind.name, use)
        spec.check_keys(content, (*CHOICE, "fallback") if is_locator else CHOICE, below)
        if not is_locator:
            return recognised_source(section, spec) if kind is KINDS["source"] and use == RECOGNISED else section
        if use == CHAIN:
            return self.chain(section)
        fallback = section.at("fallback")
        items = self.items(kind, fallback, None if "use" in content.data else DEFAULT_FALLBACK)
        return section.having({"fallback": Written(items, fallback.place)})

    def chain(self, section: Written) -> Written | None:
        """Rewrite a section that uses `chain-of-backends`: its first locator is used, and the others are the fallbacks."""
        spec = self.spec
        keys = spec.mapping(section.at("with"))
        if keys is None:
            return None
        spec.check_keys(keys, ("backends",))
        if section.at("fallback").data:
            spec.wrong_key(section.at("fallback"), "a chain cannot have a fallback; add the locator to its backends")
        backends = keys.at("backends")
        names = [Written(name, section.at("use").place) for name in (KINDS["locator"].default, DEFAULT_FALLBACK)]
        first, *others = [each.spelled_out() for each in backends.items() or names]
        if backends.data == []:
            spec.wrong(backends, "expected a list of locators, in the order in which they are tried, got an empty list")
        return first.having({"fallback": Written(others, first.place)}) if self.is_item(KINDS["locator"], first) else None

    def items(self, kind: Kind, written: Written, default: str | None = None) -> list[Written]:
        """Return the sections of a list of components; one alone is a list of it, and a name a section that uses it.

        If nothing is written, the default is chosen, if it is installed.
        """
        items = written.items()
        if written.data is None and default in self.catalog.names(kind.name):
            items = [Written(default, written.place.below(0))]
        return [each.spelled_out() for each in items]

    def fallbacks(self, section: Written, written: Written, first: Choice | None) -> tuple[Choice, ...]:
        """Resolve the locators to which the pairs that the first one lost are offered.

        `section` is spelled out, `written` as it was written.
        """
        found: list[Choice] = []
        for item in section.at("fallback").items():
            choice = self.item(KINDS["locator"], item)
            if choice is None:
                continue
            name, is_own = choice.contribution.name, item.place.where.startswith(written.place.where)
            if choice == first and not is_own:  # it became the same by what a level changes
                self.spec.wrong_key(section, f"the fallback {name!r} has the same keys, and {_AGAIN}")
            elif choice in (first, *found):
                self.spec.wrong_key(item, f"{name!r} with the same keys is tried before, and {_AGAIN}")
            else:
                found.append(choice)
        return tuple(found)

    def formats(self, items: list[Written]) -> tuple[Choice, ...]:
        """Resolve the exporters; two of them cannot write the same file."""
        found: dict[str, Choice] = {}
        for item in items:
            choice = self.item(KINDS["exporter"], item)
            if choice is None:
                continue
            assert isinstance(choice.contribution, ExporterContribution)
            name, suffix = choice.contribution.name, choice.contribution.suffix
            if suffix in found:
                other = found[suffix].contribution.name
                self.spec.wrong_key(item, f"{name!r} writes panorama{suffix}, as {other!r} does; keep one of them")
            found.setdefault(suffix, choice)
        return tuple(found.values())

    def item(self, kind: Kind, section: Written) -> Choice | None:
        """Resolve one component of a list, or one that has no default."""
        return self.component(kind, section) if self.is_item(kind, section) else None

    def is_item(self, kind: Kind, section: Written) -> bool:
        """Return whether a section is a mapping; report that it is none, and what it must not have in a list."""
        spec = self.spec
        if not isinstance(section.data, dict):
            article = "an" if kind.name[0] in "aeiou" else "a"
            expected = f"the name of {article} {kind.name}, or a mapping such as {{use: NAME}}"
            spec.wrong(section, f"expected {expected}, got {given(section.data)}")
            return False
        known = [*CHOICE]
        if kind is KINDS["locator"] and "fallback" in section.data:
            known.append("fallback")
            message = "a locator of a list cannot have a fallback; list all of them, in the order in which they are tried"
            spec.wrong_key(section.at("fallback"), message)
        spec.check_keys(section, known, below=self.catalog.keys_of(kind.name, section.at("use").data))
        return True

    def component(self, kind: Kind, section: Written) -> Choice | None:
        """Look up the component that a section names, and validate its keys."""
        entry = self.entry(kind, section)
        if entry is None:
            return None
        keys = section.at("with")
        try:
            config = validate(entry.contribution.config, keys, self.spec)
            if config is not None:
                config.model_dump(mode="json")  # a run records it
        except Exception as error:
            self.spec.wrong_key(keys, f"the config of the {entry.label} raised {described(error)}")
            return None
        return None if config is None else Choice(entry.contribution, config, entry.origin, section.place)

    def entry(self, kind: Kind, section: Written) -> Entry | None:
        """Look up the component that a section names; None if it names none, or one that there is not."""
        use = section.at("use")
        if "use" not in section.data:
            known = listed(self.catalog.names(kind.name)) or "none"
            self.spec.wrong_key(use, f"required: the name of the {kind.name}; known: {known}")
            return None
        if not isinstance(use.data, str):
            self.spec.wrong(use, f"expected the name of the {kind.name}, got {given(use.data)}")
            return None
        if kind is KINDS["locator"] and use.data == CHAIN:  # one that stands where it may has been rewritten
            message = f"{CHAIN!r} cannot be part of a chain or a fallback; list the locators themselves"
            self.spec.wrong_key(section, message)
            return None
        try:
            entry = self.catalog.find(kind.name, use.data)
        except PluginError as error:
            self.spec.wrong(use, str(error))
            return None
        if entry.unavailable:
            self.spec.wrong(use, entry.unavailable)
        return entry


def resolved_corrections(written: Written, spec: Spec) -> tuple[Correction, ...] | None:
    """Resolve the section `corrections`: a list, or `auto`, which is the default, and for which it returns None.

    Corrections with problems are left out; these are added to the spec.
    """
    if written.data is None or written.data == AUTO:
        return None
    if not isinstance(written.data, list):
        spec.wrong(written, f"expected a list of corrections, or {AUTO}, got {given(written.data)}")
        return ()
    found = (_resolved(item, spec) for item in written.data)
    return tuple(correction for correction in found if correction is not None)


def written_corrections(corrections: Iterable[Correction]) -> list[Any]:
    """Write corrections down as plain data, from which they can be resolved again."""
    settings = ((each.name, each.model_dump(mode="json")) for each in corrections)
    return [{name: keys} if keys else name for name, keys in settings]


def _resolved(item: Written, spec: Spec) -> Correction | None:
    if isinstance(item.data, str):
        name, named, settings = item.data, item, Written(None, item.place.below(item.data))
    elif isinstance(item.data, dict) and len(item.data) == 1:
        ((name, settings),) = item.data.items()
        named = settings
    else:
        got = f"a mapping of {len(item.data)}" if isinstance(item.data, dict) else given(item.data)
        expected = "the name of a correction, or a mapping of one name to its settings such as {crop: {rows: [2, null]}}"
        spec.wrong(item, f"expected {expected}, got {got}")
        return None
    if name not in CORRECTIONS:
        spec.wrong_key(named, f"there is no correction {name!r}; {suggestion(name, CORRECTIONS)}")
        return None
    correction = validate(CORRECTIONS[name], settings, spec)
    for key, file in correction or ():
        if isinstance(file, Path) and not file.exists():
            spec.wrong(settings.at(key), missing_file(file))
    return correction
