"""A few of the trials of tests/benchmarks/crashes.py: runs in processes that are killed (SIGKILL), and resumed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "crashes.py"


def test_killed_runs_end_with_the_same_bytes() -> None:
    command = [sys.executable, str(SCRIPT), "resumes", "--number", "1", "--writing", "1", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 of 1 runs ended with the same bytes and left nothing behind" in done.stdout
