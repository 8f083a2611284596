"""`use: auto` resolves to the source that recognises the path."""

import logging

import pytest
from pydantic import Field

from photonpano import Config, Recognised, SourceContribution, SpecError, SpecPath
from photonpano.specs import load_spec, parse_spec
from photonpano.values import Decision


class HalvesConfig(Config):
    path: SpecPath = Field(description="a folder of halves")
    order: str = Field("left", description="which half comes first")
    rows: int = Field(4, ge=1, description="rows of a frame")


def halves(path):
    if not (path / "left.bin").exists():
        return None
    return Recognised({"path": path, "order": "right", "rows": 8}, "left.bin lies in it")


def toy(name, recognise=lambda _: None, **more):
    return SourceContribution(name=name, summary="Toy", config=HalvesConfig, build=lambda *_: None, recognise=recognise, **more)


HALVES = toy("halves", halves)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "cube.npy").touch()
    (tmp_path / "cube.dat").write_bytes(b"12345")
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "left.bin").touch()
    return tmp_path


def parsed(folder, catalog, **keys):
    return parse_spec({"version": 1, "source": {"use": "auto", "with": keys}}, directory=folder, catalog=catalog)


def message_of(folder, catalog, text):
    """Return the problems of a spec, without the folder."""
    (folder / "scan.yaml").write_text(f"version: 1\n{text}")
    with pytest.raises(SpecError) as caught:
        load_spec(folder / "scan.yaml", catalog=catalog)
    return str(caught.value).replace(f"{folder}/", "")


def test_auto_is_the_source_that_recognises_the_path(folder, catalog):
    plan = parsed(folder, catalog, path="cube.npy", frame_rate_hz=96800)
    named = {"use": "packed-npy", "with": {"path": str(folder / "cube.npy"), "frame_rate_hz": 96800}}
    assert plan.document == parse_spec({"version": 1, "source": named}, directory=folder, catalog=catalog).document
    assert plan.recognised == Decision("source", "packed-npy", "cube.npy was recognised: its name ends in .npy")


def test_written_keys_override_recognised_keys(folder, catalog):
    plan = parsed(folder, catalog.including(HALVES), path="recording", rows=16)
    assert plan.source.config.model_dump(exclude={"frames"}) == {"path": folder / "recording", "order": "right", "rows": 16}
    assert all(plan.place(f"source.with.{key}").is_written for key in ("path", "order", "rows"))


def fussy(name, *suffixes):
    """Offer a source that recognises nothing and has a problem with every path."""
    return toy(name, check=lambda config: [f"{config.path} is not mine"], suffixes=suffixes)


FUSSY = [fussy("any"), fussy("bins", ".bin"), fussy("dats", ".dat", ".data")]


@pytest.mark.parametrize(
    ("path", "looks", "heard"),
    [("cube.dat", "a file of 5 bytes", ["any", "dats"]), ("recording", "a folder of left.bin", ["any", "bins"])],
)
def test_unrecognised_path_lists_problems_of_sources_with_its_ending(folder, catalog, path, looks, heard):
    said = message_of(folder, catalog.including(*FUSSY), f"source: {{use: auto, with: {{path: {path}}}}}")
    first, *others = said.splitlines()
    assert first == f"scan.yaml:2:34: source.with.path: no source recognises {path}, {looks}; name the one that reads it"
    assert others == [f"  {name}: {path} is not mine" for name in heard]


def test_path_recognised_by_several_sources_is_an_error(folder, catalog):
    also = toy("greedy", lambda path: Recognised({"path": path}, "it is there"))
    said = message_of(folder, catalog.including(also), "source: {use: auto, with: {path: cube.npy}}")
    assert said == (
        "scan.yaml:2:34: source.with.path: cube.npy is recognised by greedy (it is there) and packed-npy "
        "(its name ends in .npy); name the right one"
    )


def test_recognise_that_raises_is_logged_and_other_sources_are_tried(folder, catalog, caplog):
    def raises(path):
        raise LookupError("not today")

    sulky = toy("sulky", raises)
    with caplog.at_level(logging.WARNING):
        assert parsed(folder, catalog.including(sulky), path="cube.npy").source.contribution.name == "packed-npy"
    complaint = f"recognise of the source 'sulky' of {__name__} unreleased raised LookupError: not today"
    assert caplog.messages == [complaint]
    assert complaint in message_of(folder, catalog.including(sulky), "source: {use: auto, with: {path: cube.dat}}")


def test_wrong_key_of_recognised_source_names_source_and_reason(folder, catalog):
    said = message_of(folder, catalog, "source:\n  use: auto\n  with:\n    path: cube.npy\n    frame_rate: 5\n    width: 3\n")
    because = "(cube.npy was recognised as packed-npy: its name ends in .npy)"
    assert said.splitlines() == [
        f"scan.yaml:6:5: source.with.frame_rate: unknown key; did you mean 'frame_rate_hz' or 'frames'? {because}",
        f"scan.yaml:7:5: source.with.width: unknown key; known: frame_rate_hz, frames and path {because}",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("source: {use: auto}", "scan.yaml:2:1: source.with.path: required: a path"),
        ("source: {use: auto, with: {path: 5}}", "scan.yaml:2:34: source.with.path: expected a path, got 5"),
        ("source: {use: auto, with: [a]}", "scan.yaml:2:27: source.with: expected a mapping, got a list of 1"),
        ("source: {use: auto, with: {file: a}}", "scan.yaml:2:21: source.with.path: required: a path"),
        (
            "source: {use: auto, with: {path: no.npy}}",
            "scan.yaml:2:34: source.with.path: there is no file or folder no.npy; check the path",
        ),
        ("source: {use: auto, path: cube.npy}", "scan.yaml:2:21: source.path: unknown key; it belongs under `with`"),
    ],
)
def test_auto_with_wrong_path_is_an_error_at_its_place(folder, catalog, text, said):
    assert message_of(folder, catalog, text).splitlines()[-1] == said
