"""Disable plugins by an environment variable, for one command or one shell."""

from __future__ import annotations

import os
import re

from photonpano.text import listed, suggestion

VARIABLE = "PHOTONPANO_DISABLE_PLUGINS"
"""Names of distributions or entry points, separated by commas; case does not count, and `-`, `_` and `.` are alike."""


class DisabledNames:
    """The names in the environment variable, and which of them are those of a plugin."""

    def __init__(self) -> None:
        words = [word.strip() for word in os.environ.get(VARIABLE, "").split(",")]
        self._words = {_canonical(word): word for word in words if word}
        self._seen: set[str] = set()

    def disabled_by(self, *names: str) -> str | None:
        """Return the setting that disables a plugin with these names, None if there is none."""
        self._seen.update(names)
        return next((f"{VARIABLE}={self._words[_canonical(name)]}" for name in names if _canonical(name) in self._words), None)

    def unknown(self) -> str | None:
        """Return a message about names that were those of no plugin so far, None if there are none."""
        seen = {_canonical(name) for name in self._seen}
        words = [word for key, word in self._words.items() if key not in seen]
        if not words:
            return None
        hint = suggestion(words[0], self._seen) if len(words) == 1 else f"known: {listed(sorted(self._seen))}"
        are = "is no installed plugin" if len(words) == 1 else "are no installed plugins"
        return f"{VARIABLE} names {listed(map(repr, words))}, which {are}; {hint}"


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
