from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.corrections import Correction
from photonpano.photometry import packed_counts
from photonpano.specs.components import resolved_corrections
from photonpano.specs.plan import Spec
from photonpano.specs.yaml_reader import Place, from_python
from photonpano.testing import MemorySource


class PackedMemorySource(MemorySource):
    """Frames in memory that are packed as well."""

    def packed(self, span: FrameSpan) -> np.ndarray:
        return np.packbits(self.frames(span), axis=-1)

    def counts(self, span: FrameSpan) -> np.ndarray:
        return packed_counts(self.packed(span), self.info.width)


@pytest.fixture
def packed_source() -> type[PackedMemorySource]:
    return PackedMemorySource


@pytest.fixture
def corrections(tmp_path: Path) -> Callable[..., tuple[Correction, ...]]:
    """Make corrections of what a spec would say: `corrections("rot90", {"crop": {"rows": [2, None]}})`."""

    def corrections(*written: Any) -> tuple[Correction, ...]:
        spec = Spec(from_python(list(written), Place(where="corrections"), []), directory=tmp_path)
        found = resolved_corrections(spec.root, spec)
        assert spec.problems == []
        return found

    return corrections
