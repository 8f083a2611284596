"""Bring the tables of the reference up to date with the code.

    python docs/make_reference.py

The script rewrites the text between `<!-- generated: WHAT -->` and `<!-- end -->`, and nothing else. A test fails if a page is
out of date.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel

from photonpano import discover
from photonpano.api.cli.app import app, commands
from photonpano.api.cli.verbosity import PARAMETERS
from photonpano.corrections import CORRECTIONS
from photonpano.plugins.contributions import KINDS
from photonpano.plugins.description import config_rows
from photonpano.specs.resolution import SETTINGS
from photonpano.specs.settings import LevelSettings

REFERENCE = Path(__file__).parent / "reference"
BLOCK = re.compile(r"(?<=<!-- generated: )(?P<what>[^>]+) -->\n.*?(?=<!-- end -->)", re.DOTALL)
COMPUTED = {"directory": "`runs/` and the name of the spec"}  # defaults that are computed, and so are not in the model


def main() -> None:
    """Write every page of the reference that is out of date."""
    for page in sorted(REFERENCE.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (fresh := updated(text)) != text:
            page.write_text(fresh, encoding="utf-8")
            print(page)


def updated(text: str) -> str:
    """Return a page with its generated parts up to date."""
    return BLOCK.sub(lambda match: f"{match['what']} -->\n{generated(match['what'])}\n", text)


def generated(what: str) -> str:
    """Return the Markdown of a generated part, such as "settings render", "locator opencv-sift" or "command run"."""
    kind, *name = what.split()
    match kind:
        case "settings":
            return config_table(LevelSettings if name == ["levels"] else SETTINGS[name[0]])
        case "corrections":
            return corrections()
        case "correction":
            return config_table(CORRECTIONS[name[0]])
        case "command":
            return command(name)
        case "components":
            return components()
        case "functions":
            return functions(name)
        case "attributes":
            return attributes(name[0])
        case _ if kind in KINDS:
            return config_table(discover().find(kind, name[0]).contribution.config)
    raise ValueError(f"no rule makes {what!r}")


def config_table(config: type[BaseModel]) -> str:
    """Return a table of the keys of a config."""
    rows = []
    for row in config_rows(config):
        default = "required" if row.default is None else f"`{row.default}`"
        bounds = f"{row.type}, {row.bounds}" if row.bounds else row.type
        rows.append([f"`{row.key}`", COMPUTED.get(row.key, default), bounds, row.description])
    return table(["Key", "Default", "Type", "Meaning"], rows)


def components() -> str:
    """Return a table of the components of this distribution."""
    rows = [
        [f"`{KINDS[entry.kind].section}`", f"[`{entry.name}`](spec/{entry.kind}s.md#{entry.name})", entry.contribution.summary]
        for entry in discover().rows
        if entry.origin.plugin == "photonpano" and KINDS[entry.kind].section
    ]
    return table(["Section", "`use`", "What it is"], rows)


def corrections() -> str:
    """Return a table of all corrections."""
    rows = []
    for name, model in CORRECTIONS.items():
        shown = f"[`{name}`](spec/corrections.md#{name})" if model.model_fields else f"`{name}`"
        rows.append([shown, first_sentence(model)])
    return table(["Correction", "What it does"], rows)


def command(names: Sequence[str]) -> str:
    """Return a table of the arguments and options of a command."""
    node: Any = commands()[" ".join(names)] if names else typer.main.get_command(app)
    shown = [parameter for parameter in node.params if "--help" not in parameter.opts]
    if not names:  # every command takes these as well
        shown += PARAMETERS
    rows = []
    for parameter in shown:
        flags = [*parameter.opts, *parameter.secondary_opts]
        if parameter.param_type_name == "argument":
            flags = [parameter.metavar]
        elif not parameter.is_flag:
            flags[-1] += f" {parameter.metavar or parameter.name.upper()}"
        default = parameter.default if isinstance(parameter.default, bool) and parameter.secondary_opts else None
        remark = "" if default is None else f" Default: `{flags[0] if default else flags[1]}`."
        rows.append([", ".join(f"`{flag}`" for flag in flags), f"{parameter.help}{remark}"])
    return table(["Argument or option", "Meaning"], rows) if rows else "It takes no arguments."


def functions(names: Sequence[str]) -> str:
    """Return a table of functions of `photonpano`, or of the package that a name begins with."""
    rows = []
    for name in names:
        function = public(name)
        signature = inspect.signature(function)
        parameters = [each.replace(annotation=inspect.Parameter.empty) for each in signature.parameters.values()]
        call = inspect.Signature(parameters)
        result = re.sub(r"`Iterator\[(.*)\]`", r"context manager of `\1`", f"`{signature.return_annotation}`")
        rows.append([f"`{name}{call}`", result, first_sentence(function)])
    return table(["Call", "Returns", "What it does"], rows)


def public(name: str) -> Any:
    """Return what has a name in `photonpano`, or in the package that it begins with."""
    package, _, last = name.rpartition(".")
    return getattr(importlib.import_module(package or "photonpano"), last)


def attributes(name: str) -> str:
    """Return the attributes of a class of `photonpano`, from its docstring."""
    section = (inspect.getdoc(public(name)) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
    rows = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return table(["Attribute", "Meaning"], [[f"`{attribute}`", " ".join(text.split()).rstrip(".")] for attribute, text in rows])


def first_sentence(documented: object) -> str:
    """Return the first paragraph of a docstring in one line."""
    return " ".join((inspect.getdoc(documented) or "").partition("\n\n")[0].split())


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    cells = [head, ["---"] * len(head), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


if __name__ == "__main__":
    main()
