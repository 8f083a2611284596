"""Fill the templates of the pages."""

from __future__ import annotations

import io
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from photonpano import text
from photonpano.record.batch_row import written

if TYPE_CHECKING:
    from jinja2 import Environment


def filled(template: str, **values: Any) -> str:
    """Return the page that a template makes of its values."""
    page: str = _environment().get_template(template).render(**values)
    return page


@cache
def _environment() -> Environment:
    """Return the environment of the templates, with filters that write numbers."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("photonpano.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("byte_size", "count", "counted", "duration", "pixels", "rate", "share", "span"):
        environment.filters[name] = getattr(text, name)
    environment.filters["setting"] = written
    return environment


def yaml_of(document: Mapping[str, Any]) -> str:
    """Write a spec as YAML."""
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 100
    buffer = io.StringIO()
    yaml.dump(document, buffer)
    return buffer.getvalue()
