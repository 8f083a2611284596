"""Machine code that is kept beside modules."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

MODULE = "from photonpano.compiling import compiled\n\n@compiled\ndef double(x):\n    return 2 * x\n"
RUN = """
import os, sys
from contextlib import suppress
from numba.core import caching
sys.path.insert(0, "modules")
if READ_ONLY:  # root may write everywhere, and another user not
    access, make = os.access, caching._CacheLocator.ensure_cache_path
    os.access = lambda path, mode: mode != os.W_OK and access(path, mode)
    def refused(self):
        raise OSError("read-only")
    caching._CacheLocator.ensure_cache_path = refused
from photonpano.compiling import notify_on_first_compile
with notify_on_first_compile(lambda: print("compiled")):
    from loops import double
    print(double(VALUE))
"""


def test_code_of_another_user_is_read_and_none_is_written(tmp_path: Path) -> None:
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "loops.py").write_text(MODULE)

    def printed(value: str, read_only: bool) -> str:
        code = RUN.replace("READ_ONLY", str(read_only)).replace("VALUE", value)
        return subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    assert printed("3", read_only=False) == "compiled\n6\n"
    kept = sorted(folder.rglob("*.nb?"))
    assert kept
    assert printed("3", read_only=True) == "6\n"
    assert printed("1.5", read_only=True) == "compiled\n3.0\n"
    assert sorted(folder.rglob("*.nb?")) == kept
