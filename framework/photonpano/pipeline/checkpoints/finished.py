"""Find a run that is finished already, so that nothing is left to do."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from typing import Any

from photonpano.captures.fingerprint import CaptureRecord, changes
from photonpano.errors import InputError
from photonpano.record.contents import changed_files
from photonpano.record.environment import library_versions, plugin_records
from photonpano.record.run_json import read_record
from photonpano.record.schema import RunRecord
from photonpano.specs.plan import Plan


def finished_run(plan: Plan, capture: CaptureRecord) -> RunRecord | None:
    """Return the record in the run folder of a plan, if it is of this spec, capture and software, and unchanged.

    Args:
        plan: what would be run.
        capture: the fingerprint of the capture as it is now.
    """
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
        result = record["verdict"] if plan.pose is None else record["poses"]
        return record if same and result is not None else None
    except (InputError, KeyError, TypeError, AttributeError):
        return None


def _without_machine(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a spec as plain data, without what results do not depend on: the run folder, threads, and executor."""
    run = {key: value for key, value in document["run"].items() if key not in ("threads", "executor")}
    plain: dict[str, Any] = json.loads(json.dumps({**document, "run": run}))
    plain.pop("output", None)
    return plain
