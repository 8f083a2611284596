"""Fingerprints of what the results of a run depend on, in parts that messages can name; and of runs that are finished."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import photonpano
from photonpano.errors import InputError
from photonpano.pipeline.components import scale_of
from photonpano.record.contents import changed_files, changes
from photonpano.record.run_json import library_versions, plugin_records, read_record
from photonpano.record.schema import CaptureRecord, RunRecord
from photonpano.specs.plan import Choice, Plan

Fingerprint = dict[str, Any]
_STAGES = ("resample", "merge", "locate", "interpolate")


def run_fingerprint(plan: Plan, capture: CaptureRecord, frame_shape: tuple[int, int]) -> Fingerprint:
    """Return what the results of a run depend on, as plain data; neither the threads nor the run folder.

    Returns:
        `versions`, `code` and `capture`, on which everything depends; `common`, the parts of the spec on which it does;
            `levels`, a list; and `rest`, what only the steps after the last level depend on.
    """
    document = plan.document
    rest = {
        "refine": [_component(choice) for choice in plan.refine],
        "render": {**document["render"], **_component(plan.renderer), "code": _code([plan.renderer])},
        "memory": int(plan.run.memory),
        "formats": [{**_component(choice), "code": _code([choice])} for choice in plan.formats],
    }
    found = {
        "versions": {"photonpano": importlib.metadata.version("photonpano"), **library_versions(plan)},
        "code": _code([plan.source], photonpano),
        "capture": capture,
        "common": {
            "source": _component(plan.source),
            "corrections": document.get("corrections"),
            **{section: document[section] for section in ("motion", "camera", "light", "graph")},
            "run.seed": plan.run.seed,
            "render.reference": document["render"]["reference"],
        },
        "levels": [_level(plan, number, frame_shape) for number in range(1, len(plan.levels) + 1)],
        "rest": rest,
    }
    as_read: Fingerprint = json.loads(json.dumps(found))
    return as_read


def differences(before: Fingerprint, now: Fingerprint, levels: int | None = None) -> list[str]:
    """Return what differs between two fingerprints, a clause each; with `levels`, only what these levels depend on."""
    found = [
        f"the version of {path} was {old} and is {new}" for path, old, new in _changed(before["versions"], now["versions"])
    ]
    found += [f"the code of {path} has changed" for path, _, _ in _changed(before["code"], now["code"])]
    found += changes(before["capture"], now["capture"])
    found += _settings(before["common"], now["common"])
    if levels is None and len(before["levels"]) != len(now["levels"]):
        found.append(f"there were {len(before['levels'])} levels and are {len(now['levels'])}")
    for number, (old, new) in enumerate(zip(before["levels"][:levels], now["levels"][:levels], strict=False), start=1):
        found += _settings(old, new, f" at level {number}")
    return found if levels is not None else found + _settings(before["rest"], now["rest"])


def finished_run(plan: Plan, capture: CaptureRecord) -> RunRecord | None:
    """Return the record in the run folder of a plan, if it is of this spec, capture and software, and unchanged."""
    try:
        record = read_record(plan.output.directory)
        same = (
            record["photonpano"] == importlib.metadata.version("photonpano")
            and record["libraries"] == library_versions(plan)
            and record["plugins"] == plugin_records(plan)
            and _without_machine(record["spec"]) == _without_machine(plan.document)
            and not changes(record["capture"], capture)
            and all((plan.output.directory / name).exists() for name in record["files"])
            and not changed_files(plan.output.directory)
            and (plan.output.keep is None or record["spec"]["output"].get("keep") == plan.output.keep)
        )
        return record if same and record["verdict"] is not None else None
    except (InputError, KeyError, TypeError, AttributeError):
        return None


def _without_machine(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a spec as plain data, without what results do not depend on: the run folder, threads, and executor."""
    run = {key: value for key, value in document["run"].items() if key not in ("threads", "executor")}
    plain: dict[str, Any] = json.loads(json.dumps({**document, "run": run}))
    plain.pop("output", None)
    return plain


def _level(plan: Plan, number: int, frame_shape: tuple[int, int]) -> dict[str, Any]:
    level = plan.levels[number - 1]
    choices = {stage: getattr(level, stage) for stage in _STAGES}
    return {
        "scale": scale_of(plan, number, frame_shape),
        **{stage: _component(choice) for stage, choice in choices.items()},
        "fallback": [_component(choice) for choice in level.fallbacks],
        "code": _code([*choices.values(), *level.fallbacks]),
    }


def _component(choice: Choice) -> dict[str, Any]:
    return {
        "use": choice.contribution.name,
        "plugin": f"{choice.origin.plugin} {choice.origin.version}",
        "with": choice.config.model_dump(mode="json"),
    }


def _code(choices: Sequence[Choice], *packages: Any) -> dict[str, str]:
    """Return hashes of the Python files of plugins, by package: while its author works on a plugin, its version stays."""
    built_by = (sys.modules.get(choice.contribution.build.__module__.partition(".")[0]) for choice in choices)
    return {
        module.__name__: _hash_of(module.__file__) for module in (*packages, *built_by) if getattr(module, "__file__", None)
    }


@cache
def _hash_of(file: str) -> str:
    """Hash a module; of a package, all its Python files."""
    path, found = Path(file), hashlib.blake2b(digest_size=16)
    files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    for each in files:
        found.update(f"{each.relative_to(path.parent)}\0".encode())
        found.update(hashlib.sha256(each.read_bytes()).digest())
    return found.hexdigest()


def _settings(before: Any, now: Any, where: str = "") -> list[str]:
    return [
        f"the code of {path.removeprefix('code.')} has changed"
        if path.startswith("code.")
        else f"{path} was {_short(old)} and is {_short(new)}{where}"
        for path, old, new in _changed(before, now)
    ]


def _changed(before: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the places where two values of plain data differ, with both values; None stands for nothing."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*before, *now]):
            yield from _changed(before.get(key), now.get(key), f"{path}.{key}" if path else key)
    elif before != now:
        yield path, before, now


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
