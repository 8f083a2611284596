from __future__ import annotations

from photonpano.report.page import failure_groups


def failure(start: int, reason: str) -> dict:
    return {"moving": [start, start + 5], "fixed": [start + 5, start + 10], "reason": reason}


def test_failure_groups_ignore_numbers_in_reasons():
    levels = [
        {"level": 1, "failures": [failure(0, "too dark"), *(failure(k, f"only {k} of -3.5 agree") for k in range(5))]},
        {"level": 2, "failures": [failure(9, "too dark"), failure(19, "too dark")]},
    ]
    groups = failure_groups(levels)
    assert [(group.level, len(group.failures), group.reason) for group in groups] == [
        (1, 5, "only 0 of -3.5 agree"),
        (1, 1, "too dark"),
        (2, 2, "too dark"),
    ]
    assert [group.alike for group in groups] == [False, True, True]
    assert [group.more for group in groups] == [2, 0, 0]
    assert [pair["moving"][0] for pair in groups[0].examples] == [0, 1, 2]
