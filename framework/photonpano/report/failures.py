"""Group the pairs that were not located by their reason."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

from photonpano.record.schema import FailureRecord, LevelRecord

MAX_EXAMPLES = 3
"""Number of pairs of a group that are listed."""


class FailedLevel(TypedDict):
    """The pairs of a level that were not located."""

    level: int
    failures: Sequence[FailureRecord]


@dataclass(frozen=True, slots=True)
class FailureGroup:
    """Pairs of one level that failed for the same reason, apart from the numbers in it.

    Attributes:
        level: the level.
        failures: the pairs, in order.
    """

    level: int
    failures: tuple[FailureRecord, ...]

    @property
    def reason(self) -> str:
        """The reason of the first pair, with its numbers."""
        return self.failures[0]["reason"]

    @property
    def alike(self) -> bool:
        """Whether all pairs have the same reason, numbers included."""
        return len({failure["reason"] for failure in self.failures}) == 1

    @property
    def examples(self) -> tuple[FailureRecord, ...]:
        """The first pairs."""
        return self.failures[:MAX_EXAMPLES]

    @property
    def more(self) -> int:
        """Number of pairs that are not among the examples."""
        return len(self.failures) - len(self.examples)


def failure_groups(levels: Sequence[LevelRecord | FailedLevel]) -> list[FailureGroup]:
    """Group the failures of each level by reason, the largest groups first."""
    groups = []
    for level in levels:
        alike: dict[str, list[FailureRecord]] = {}
        for failure in level["failures"]:
            alike.setdefault(re.sub(r"[-+]?\d+(\.\d+)?", "#", failure["reason"]), []).append(failure)
        by_size = sorted(alike.values(), key=len, reverse=True)
        groups += [FailureGroup(level["level"], tuple(failures)) for failures in by_size]
    return groups
