"""What breaks a contract is refused with the same sentence, that of contracts.txt, by the conformance kit and by a run."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Located, NotLocated, Refined, testing
from photonpano.geometry import translation

from .contracts import BROKEN, FAILING, ONLY_IN_A_RUN, STRICT, Change, info, refined, rows
from .strange import KINDS, Outcome, around, require_named

KITS = {kit.kind: kit for name in testing.__all__ if name.endswith("Conformance") for kit in [getattr(testing, name)]}
CONTRACTS = {kind: kit for kind, kit in KITS.items() if hasattr(kit, "contracts")}
REFUSED = rows(BROKEN, ONLY_IN_A_RUN, FAILING)
# What is said of each component, behind the name of its plugin; "#" is any number, and "..." any text.
GOLDEN = dict(line.split(" -> ") for line in Path(__file__).with_name("contracts.txt").read_text().splitlines())
NUMBER = r"\d[\d.]*(?:e[-+]?\d+)?|\bnan\b|\binf\b"


def pattern(golden: str) -> str:
    return re.escape(golden).replace(r"\#", f"-?(?:{NUMBER})").replace(re.escape("..."), r"(?s:.*)")


def clause(golden: str) -> str:
    """Return the clause of a golden message, without the place in a run, and without numbers: those of the kit differ."""
    return re.sub(NUMBER, "#", re.sub("^broke its contract at .*?: ", "", golden))


@pytest.fixture
def kit_says(failure: Callable[..., str | None], catalog: Any) -> Callable[[str, Change], str | None]:
    """Return what the kit says of a component that `change` makes of a good one, by the same name."""

    def kit_says(kind: str, change: Change) -> str | None:
        inner = catalog.find(kind, KINDS[kind][2]).contribution
        config = {"group_size": 40} if kind == "resampler" else {}
        check = "test_answers_keep_the_contract" if kind in CONTRACTS else "test_source_passes_the_checks_of_a_run"
        settings = inner.config.model_validate(config)
        record = {"config": inner.config}
        return failure(KITS[kind], check, lambda context: change(inner.build(settings, context)), record=record, config=config)

    return kit_says


@pytest.mark.parametrize(("name", "kind", "change"), REFUSED.values(), ids=REFUSED)
def test_run_with_a_broken_component_names_its_plugin(
    misbehaving: Callable[..., Outcome], name: str, kind: str, change: Change
) -> None:
    label = f"error: {kind} 'strange' of strange-plugin 1.2 "
    outcome = misbehaving(kind, change)
    assert (outcome.code, outcome.files) == (1, [])
    assert re.fullmatch(re.escape(label) + pattern(GOLDEN[name]), outcome.printed.partition("\n")[0]), outcome.printed


@pytest.mark.parametrize(("name", "kind", "change"), rows(BROKEN).values(), ids=rows(BROKEN))
def test_kit_refuses_what_a_run_refuses(kit_says: Callable[..., str | None], name: str, kind: str, change: Change) -> None:
    found = str(kit_says(kind, change)).partition("\nassert ")[0]
    assert re.fullmatch("a run refuses .*?: " + pattern(clause(GOLDEN[name])), found), found


@pytest.mark.parametrize(("name", "kind", "change"), rows(STRICT).values(), ids=rows(STRICT))
def test_kit_alone_refuses_what_a_run_converts(
    misbehaving: Callable[..., Outcome], kit_says: Callable[..., str | None], name: str, kind: str, change: Change
) -> None:
    assert misbehaving(kind, change).code == 0
    found = str(kit_says(kind, change)).partition("\nassert ")[0]
    assert re.fullmatch(".* breaks the contract: " + pattern(clause(GOLDEN[name])), found), found


@pytest.mark.parametrize("kind", CONTRACTS)
def test_good_component_keeps_every_rule_and_every_rule_is_broken_by_one(
    kit_says: Callable[..., str | None], kind: str
) -> None:
    assert kit_says(kind, lambda inner: inner) is None
    sentences = [clause(GOLDEN[name]) for name, of, _ in rows(BROKEN, STRICT).values() if of == kind]
    for template, _ in CONTRACTS[kind].rules():
        begins = re.sub(NUMBER, "#", template).partition("{")[0]
        assert any(sentence.startswith(begins) for sentence in sentences), template


def test_identity_at_a_later_level_names_locator(misbehaving: Callable[..., Outcome]) -> None:
    """Level 1 succeeds, so the motion is known at level 2."""

    def at_later_levels(found: Any, moving: Any, fixed: Any, initial: Any) -> Any:
        return found if initial is None else Located(np.eye(3))

    def plain(inner: Any) -> Any:
        changed = around("register", at_later_levels)(inner)
        return type("Plain", (), {"describe": inner.describe, "register": staticmethod(changed.register)})()

    outcome = misbehaving("locator", plain, levels=2)
    require_named(outcome, "locator", "broke its contract at level 2: got the identity where the motion known so far moves")
    moved = re.search(r"the corners by (\d+) px; a failure is NotLocated$", outcome.printed, re.MULTILINE)
    assert moved is not None
    assert 5 <= int(moved[1]) <= 11, "of a pair of the first exposures, which are 30 to 70 frames of 0.16 px apart"


def test_source_with_fewer_frames_than_info_says_is_an_error(misbehaving: Callable[..., Outcome]) -> None:
    outcome = misbehaving("source", info(n_frames=400))
    assert (outcome.code, outcome.files) == (1, [])
    assert outcome.printed.endswith("were requested, but the capture has 160 frames (0 to 159)\n")


@pytest.mark.parametrize(
    "moved",
    [lambda frame: translation(1e6 * frame, 0), lambda frame: translation(30 * (-1) ** frame, 0)],
    ids=["far away", "shaken"],
)
def test_refiner_that_makes_the_motion_worse_is_kept_out(
    misbehaving: Callable[..., Outcome], moved: Callable[[int], np.ndarray]
) -> None:
    outcome = misbehaving("refiner", refined(lambda found, std: Refined(found @ [*map(moved, range(160))], std, "worse")))
    assert outcome.code == 0
    assert outcome.record is not None
    (refinement,) = outcome.record["refinements"]
    assert (refinement["use"], refinement["rounds"]) == ("strange", [])
    assert refinement["kept_out"]


def test_record_converts_numpy_and_non_finite_numbers(misbehaving: Callable[..., Outcome], tmp_path: Path) -> None:
    """A locator that loses the first pair, with evidence of numpy types."""
    lost = [NotLocated("shy", {"matches": np.int64(7), "score": np.float32(0.5), "ncc": np.nan, "found": np.True_})]
    assert misbehaving("locator", around("register", lambda found, *_: lost.pop() if lost else found)).code == 0
    (failure,) = json.loads((tmp_path / "run" / "run.json").read_text())["levels"][0]["failures"]
    assert failure["evidence"] == {"matches": 7, "score": 0.5, "ncc": None, "found": True}
