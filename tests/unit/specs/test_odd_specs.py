"""Odd specs: each is a plan, or a list of problems that names every place, in a second."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from photonpano import SpecError
from photonpano.registry import Catalog
from photonpano.specs import load_spec

OUTCOMES = Path(__file__).with_suffix(".txt")
"""What becomes of each: `NAME -> PROBLEM / PROBLEM`, or `NAME -> a plan`."""
BASE = "version: 1\nsource: {use: simulator}\n"
LONGEST_S = 1.0
VALUES: Mapping[str, str] = {
    "nothing": "",
    "empty text": "''",
    "a text of digits": "'3'",
    "a huge number": "1e400",
    "many digits": "9" * 400,
    "NaN": ".nan",
    "an empty list": "[]",
    "an empty mapping": "{}",
    "a mapping": "{a: 1}",
    "a tag": "!!python/object/apply:os.abort []",
    "right to left": "'\u202egnp.exe'",
    "NUL": '"a\\0b"',
}
PLACES: Mapping[str, str] = {
    "version": "version: VALUE\nsource: {use: simulator}\n",
    "source": "version: 1\nsource: VALUE\n",
    "source.use": "version: 1\nsource: {use: VALUE}\n",
    "source.with": "version: 1\nsource: {use: simulator, with: VALUE}\n",
    "levels": BASE + "levels: VALUE\n",
    "run.seed": BASE + "run: {seed: VALUE}\n",
    "output.directory": BASE + "output: {directory: VALUE}\n",
}
DOCUMENTS: Mapping[str, str | bytes] = {
    "two colons": "version:: 1\n",
    "an anchor without value": "version: 1\nsource: &a\nlocate: *a\n",
    "an alias before its anchor": "version: 1\nsource: *a\nlocate: &a direct\n",
    "a merge of itself": "version: 1\nsource: &a {<<: *a}\n",
    "a key of 10,000 letters": BASE + "k" * 10_000 + ": 1\n",
    "a key with a line end": BASE + '"a\\nb": 1\n',
    "1,000 levels": BASE + "levels: [" + "{}, " * 1000 + "]\n",
    "capital letters": "Version: 1\nSOURCE: {Use: simulator}\n",
    "Windows line ends": BASE.replace("\n", "\r\n"),
    "old Macintosh line ends": BASE.replace("\n", "\r"),
    "tabs between": "version:\t1\nsource:\t{use:\tsimulator}\n",
    "a byte order mark": b"\xef\xbb\xbf" + BASE.encode(),
    "UTF-16": BASE.encode("utf-16"),
    "Latin 1": BASE.encode() + b"output: {directory: caf\xe9}\n",
    "a directive": "%YAML 1.1\n---\n" + BASE,
    "a directive of the future": "%YAML 9.9\n---\n" + BASE,
    "an unknown directive": "%FOO\n---\n" + BASE,
    "only a comment": "# nothing\n",
    "only a line": "---\n",
    "a program": "#!/bin/sh\nexit 0\n",
    "JSON": '{"version": 1, "source": {"use": "simulator"}}',
    "JSON with a trap": '{"version": 1, "source": {"use": "simulator"}, "version": 1}',
    "TOML": "version = 1\n[source]\nuse = 'simulator'\n",
    "XML": "<spec><version>1</version></spec>",
    "200 corrections": BASE + "corrections: [" + "rot90, " * 200 + "]\n",
    "1,000 skips": BASE + "graph: {skips: [" + "1, " * 1000 + "]}\n",
}


def specs() -> Iterator[tuple[str, str | bytes]]:
    for place, form in PLACES.items():
        yield from ((f"{place} of {name}", form.replace("VALUE", value)) for name, value in VALUES.items())
    yield from DOCUMENTS.items()


CASES = dict(specs())


def expected() -> dict[str, str]:
    return dict(line.split(" -> ", 1) for line in OUTCOMES.read_text(encoding="utf-8").splitlines())


def test_every_case_has_an_outcome() -> None:
    assert list(expected()) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_odd_spec_is_a_plan_or_a_list_of_problems(
    name: str, catalog: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = CASES[name]
    Path("scan.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    start = time.process_time()
    try:
        load_spec("scan.yaml", catalog=catalog)
        ended = "a plan"
    except SpecError as error:
        ended = " / ".join(str(error).splitlines()).replace(str(tmp_path), "DIR")
    assert time.process_time() - start < LONGEST_S
    assert ended == expected()[name]
