"""Whether trusted runs are right, over five seeds of each kind of difficult capture: an hour on two cores."""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parent))
from trust import main
from trust_scores import is_wrong, status

MOST_WRONG = 0.01  # share of the trusted runs


def test_trusted_runs_are_right_and_claim_the_errors_that_they_have(tmp_path: Path) -> None:
    main(seeds=5, small=True, jobs=2, output=tmp_path / "trust.json")
    results = json.loads((tmp_path / "trust.json").read_text(encoding="utf-8"))["results"]
    trusted = [each for each in results if status(each) == "trusted"]
    wrong = [f"{each['row']}, seed {each['seed']}" for each in trusted if is_wrong(each)]
    assert len(wrong) <= MOST_WRONG * len(trusted), wrong
    assert np.mean([each["within_2"] for each in trusted]) >= 0.97
    assert np.mean([each["within_3"] for each in trusted]) >= 0.99
    assert all(status(each) != "crashed" for each in results)
