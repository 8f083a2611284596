"""What runs of difficult captures say of themselves: whether it is honest, right, and for the right reason; and the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from trust_captures import ROWS

WITHIN_2, WITHIN_3, WIDEST = 0.95, 0.99, 3.0
"""What makes a trusted run honest: shares of the frames within 2 and 3 std_px, and the mean std_px over the rms error."""
# A run is wrong if its mean error exceeds this, and its mean std_px as many times; or if a smaller share is within 2 std_px.
WRONG_PX, WRONG_TIMES, WRONG_WITHIN_2 = 0.3, 3.0, 0.9
CAUSES: dict[str, tuple[str, ...]] = {
    "tremor": ("within groups",),
    "tutorial": ("within groups",),
    "vibration": ("within groups",),
    "shake": ("within groups",),
    "shaking": ("shake",),
    **dict.fromkeys(("acceleration", "jerks", "kicks", "taps", "sine"), ("within groups", "shake", "expected error")),
    **dict.fromkeys(("sudden stop", "drops"), ("within groups", "shake", "jump", "missing")),
    "horizon": ("one direction", "repeat"),
    **dict.fromkeys(("afterpulsing", "crosstalk"), ("does not explain the photons",)),
    "half black": ("expected error",),
    "turn": ("lens", "expected error"),
    "in reverse": (),
    "gain 5 %": ("the sensor", "still", "a sensor"),
    "out of order": (),
    "any order": (),
    "every frame doubled": ("copies", "doubled"),
    "first ": ("frames", "short"),
    "sensitivity": ("the sensor",),
    "lamp": ("light",),
    "night": ("expected error", "no texture", "light"),
    "travel": ("depth", "turn", "near"),
    "people": ("move by themselves",),
    "shutter": ("jump", "show nothing"),
    "nearer": ("depth", "near"),
    "ends without texture": ("expected error", "one direction"),
    "pan of 1.5": ("within groups", "expected error", "contradict"),
    "hot pixels": ("single pixels", "still"),
    "dirt": ("the sensor", "still"),
    "window": ("the sensor", "still", "stand"),
    "lens k1": ("lens",),
    "vignette": ("the sensor",),
    "missing": ("missing",),
    "jump": ("missing", "jump"),
    "doubled": ("doubled",),
    "object": ("move by themselves", "another motion"),
    "light": ("light",),
    "parallax": ("depth",),
    "repeat": ("repeat",),
    "checkerboard": ("repeat",),
    "stripes": ("repeat", "no texture"),
    "unpacked": ("not packed",),
    "lowest bit": ("bit",),
    "along the height": ("axis", "height", "packed"),
}
"""For words in the names of rows: words of which a right reason of a doubt or a refusal has one."""
Result: TypeAlias = dict[str, Any]  # what was measured of one run; see `measured`


def status(result: Result) -> str:
    """Return what a run says of itself: trusted, doubtful, refused, crashed, or - without a verdict."""
    if result["exit_code"] is None:
        return "crashed"
    if result["exit_code"]:
        return "refused"
    return result["verdict"]["status"] if result["verdict"] else "-"


def is_honest(result: Result) -> bool:
    """Return whether a run that is not doubtful or refused claims the errors that it has."""
    says = status(result)
    if says in ("doubtful", "refused", "crashed") or "mean_px" not in result:
        return says in ("doubtful", "refused")
    narrow = result["std_px"] <= WIDEST * result["rms_px"]
    return bool(result["within_2"] >= WITHIN_2 and result["within_3"] >= WITHIN_3 and narrow)


def reasons(result: Result) -> list[str]:
    """Return why a run is doubtful, or was refused."""
    found = [str(reason.get("what", reason)) for reason in (result["verdict"] or {}).get("reasons", ())]
    return [*found, *filter(None, [result["message"]])]


def names_its_cause(result: Result) -> bool:
    """Return whether one of the reasons of a run is the right one: see `CAUSES`."""
    words = [word for part, of_part in CAUSES.items() if part in result["row"] for word in of_part]
    return any(word in reason for reason in reasons(result) for word in words)


def table(results: Sequence[Result]) -> str:
    """Return one row of Markdown for each kind of capture, over its seeds."""
    header = (
        "| Capture | Mean (max) | Claimed | Within 2 / 3 std | std / rms | / clean | Below oracle | Says | Right reason "
        "| Honest | Time |"
    )
    lines = [header, "| --- " * 11 + "|"]
    for name in dict.fromkeys(result["row"] for result in results):
        of_row = [result for result in results if result["row"] == name]
        if of_row:
            lines.append(f"| {name} | {' | '.join(cells(of_row, results))} |")
    summary = " ".join(summary_of(results))
    return "\n".join([*lines, "", summary, "", *notes(results)])


def summary_of(results: Sequence[Result]) -> Iterator[str]:
    """Yield sentences on all runs."""
    doubts = doubted(results)
    right = f"{sum(map(names_its_cause, doubts))} of {len(doubts)} that are doubtful or refused name the cause"
    yield f"{sum(map(is_honest, results))} of {len(results)} runs are honest; {right}."
    scored = [result for result in results if "mean_px" in result]
    for says in ("trusted", "doubtful"):
        said = [result for result in scored if status(result) == says]
        if said:
            shares = " / ".join(f"{np.mean([each[key] for each in said]):.1%}" for key in ("within_2", "within_3"))
            ratio = np.median([each["std_px"] / each["rms_px"] for each in said])
            wrong = [result["row"] for result in said if is_wrong(result)]
            named = f" ({', '.join(wrong)})" if wrong and says == "trusted" else ""
            within = f"{shares} of their frames are within 2 / 3 std_px, which is {ratio:.2f} times the rms error (median)"
            yield f"{len(said)} are {says}, {len(wrong)} of them wrong{named}; {within}."


def is_wrong(result: Result) -> bool:
    """Return whether errors are far larger than those that a run claims."""
    far = result["mean_px"] > max(WRONG_PX, WRONG_TIMES * result["std_px"])
    return bool(far or result["within_2"] < WRONG_WITHIN_2)


def doubted(results: Sequence[Result]) -> list[Result]:
    """Return the runs that are doubtful or were refused."""
    return [result for result in results if status(result) in ("doubtful", "refused")]


def cells(of_row: Sequence[Result], results: Sequence[Result]) -> Iterator[str]:
    """Yield the cells of a row: means over its seeds, the largest error, and the smallest shares."""
    scored = [result for result in of_row if "mean_px" in result]
    if scored:
        mean_px, std_px, rms_px = (np.mean([each[key] for each in scored]) for key in ("mean_px", "std_px", "rms_px"))
        yield f"{mean_px:.3f} ({max(each['max_px'] for each in scored):.2f})"
        yield f"{std_px:.3f}"
        yield " / ".join(f"{min(each[key] for each in scored):.0%}" for key in ("within_2", "within_3"))
        yield f"{std_px / rms_px:.2f}"
        yield of_clean(scored, results)
        losses = [each["below_oracle_db"] for each in scored if each.get("below_oracle_db") is not None]
        yield f"{np.mean(losses):.2f} dB" if losses else "-"
    else:
        yield from "------"
    says = [status(each) for each in of_row]
    yield ", ".join(word if len(says) == 1 else f"{says.count(word)} {word}" for word in dict.fromkeys(says))
    doubts = doubted(of_row)
    yield f"{sum(map(names_its_cause, doubts))} of {len(doubts)}" if doubts else "-"
    yield f"{sum(map(is_honest, of_row))} of {len(of_row)}"
    yield f"{np.mean([each['seconds'] for each in of_row]):.0f} s"


def of_clean(scored: Sequence[Result], results: Sequence[Result]) -> str:
    """Return the error of a row divided by that of its undisturbed captures of the same seeds."""
    base = ROWS[scored[0]["row"].rpartition(": ")[2]].base
    clean = {each["seed"]: each["mean_px"] for each in results if each["row"] == base and "mean_px" in each}
    ratios = [each["mean_px"] / clean[each["seed"]] for each in scored if each["seed"] in clean]
    return f"{np.mean(ratios):.2f}" if ratios and scored[0]["row"] != base else "-"


def notes(results: Sequence[Result]) -> Iterator[str]:
    """Yield, for each run, what it said: reasons of a doubt or a refusal, and warnings."""
    for result in results:
        said = [each.splitlines()[0] for each in (*reasons(result), *result["warnings"])]
        if said:
            yield f"- {result['row']}, seed {result['seed']}: {'; '.join(said)}"
