"""Plugins that are switched off by an environment variable, for one command or one shell."""

from __future__ import annotations

import os
import re

from photonpano.text import listed, suggestion

DISABLE = "PHOTONPANO_DISABLE_PLUGINS"
"""Names of distributions or entry points, separated by commas."""


class Switch:
    """What the environment disables. Case does not count, nor the choice between `-`, `_` and `.`, as in names of packages."""

    def __init__(self) -> None:
        words = [word.strip() for word in os.environ.get(DISABLE, "").split(",")]
        self._words = {_canonical(word): word for word in words if word}
        self._seen: set[str] = set()

    def word_for(self, *names: str) -> str | None:
        """Return the word that disables a plugin with these names, None if there is none."""
        self._seen.update(names)
        return next((self._words[_canonical(name)] for name in names if _canonical(name) in self._words), None)

    def unknown(self) -> str | None:
        """Say which words have named no plugin so far, None if all did."""
        seen = {_canonical(name) for name in self._seen}
        words = [word for key, word in self._words.items() if key not in seen]
        if not words:
            return None
        hint = suggestion(words[0], self._seen) if len(words) == 1 else f"known: {listed(sorted(self._seen))}"
        are = "is no installed plugin" if len(words) == 1 else "are no installed plugins"
        return f"{DISABLE} names {listed(map(repr, words))}, which {are}; {hint}"


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
