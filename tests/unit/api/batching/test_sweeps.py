from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import SpecError
from photonpano.api.batch import Batch, prepare_batch
from photonpano.api.batching.sweeps import combinations, folder_name

SPEC = {"version": 1, "source": {"use": "auto"}, "resample": {"with": {"group_size": 25}}}


@pytest.fixture
def prepare(tmp_path: Path) -> Callable[..., Batch]:
    """Prepare a batch of one capture that is missing, and one that is there."""
    np.save(tmp_path / "cube.npy", np.zeros((200, 64, 12), np.uint8))

    def prepare(spec: dict[str, Any] = SPEC, **options: Any) -> Batch:
        return prepare_batch(spec, [tmp_path / "absent.npy", tmp_path / "cube.npy"], tmp_path / "out", **options)

    return prepare


def problems(caught: pytest.ExceptionInfo[SpecError]) -> list[str]:
    return [str(each) for each in caught.value.problems]


def test_every_combination_has_a_folder_of_its_own(prepare: Callable[..., Batch], tmp_path: Path) -> None:
    batch = prepare(changes=["run.seed=1", "resample.with.group_size=[20, 25]"], swept=["levels=1,2", "run.memory=2 GiB"])
    assert batch.common == ("run.seed=1",)
    assert batch.keys == ("resample.with.group_size", "levels", "run.memory")
    folders = [row.directory.relative_to(tmp_path / "out").as_posix() for row in batch.rows]
    assert len({*folders}) == 8
    assert re.fullmatch(r"absent,resample\.with\.group_size=20,levels=1,run\.memory=2_GiB-[0-9a-f]{8}", folders[0])
    assert [dict(row.settings) for row in batch.rows[:2]] == [
        {"resample.with.group_size": 20, "levels": 1, "run.memory": "2 GiB"},
        {"resample.with.group_size": 20, "levels": 2, "run.memory": "2 GiB"},
    ]


@pytest.mark.parametrize(
    ("changes", "swept", "common", "keys"),
    [
        (["camera.centre_px=[3, 4]"], [], ["camera.centre_px=[3, 4]"], {}),
        (["refine=[]"], [], ["refine=[]"], {}),
        (["locate.use=[direct, opencv-sift]"], [], [], {"locate.use": ["direct", "opencv-sift"]}),
        ([], ["camera.centre_px=[3, 4],[5, 6]"], [], {"camera.centre_px": [[3, 4], [5, 6]]}),
        ([], ["run.seed=[1, 2, 1]"], [], {"run.seed": [1, 2]}),
        ([], ["levels=[{}],[{}, {scale: 1}]"], [], {"levels": [[{}], [{}, {"scale": 1}]]}),
    ],
)
def test_list_sweeps_keys_that_take_none(
    prepare: Callable[..., Batch], changes: list[str], swept: list[str], common: list[str], keys: dict[str, list[Any]]
) -> None:
    batch = prepare(changes=changes, swept=swept)
    assert list(batch.common) == common
    assert [dict(row.settings) for row in batch.rows if row.name == "cube"] == combinations(keys)


def test_all_problems_come_before_anything_runs(prepare: Callable[..., Batch]) -> None:
    with pytest.raises(SpecError) as caught:
        prepare(changes=["run.sed=1"], swept=["resample.with.gruop_size=20,25", "levels=2,9", "run.seed=0,-1"])
    assert problems(caught) == [
        "resample.with.gruop_size: unknown key; did you mean 'group_size'? (in the override resample.with.gruop_size=20)",
        "run.sed: unknown key; did you mean 'seed'? (in the override run.sed=1)",
        "run.seed: expected an integer of at least 0, got -1 (in the override run.seed=-1)",
        "levels: expected an integer from 1 to 8, until-converged, or a list with an entry for each level, got 9 "
        "(in the override levels=9)",
    ]


@pytest.mark.parametrize(
    ("changes", "swept", "message"),
    [
        ([], ["run.seed"], "expected KEY=VALUE, such as run.seed=1 (in the override run.seed)"),
        (
            [],
            ["run.seed="],
            "run.seed: expected values with commas between them, such as 50,100,200 (in the override run.seed=)",
        ),
        (
            [],
            ["run.seed=1,2", "run.seed=3"],
            "run.seed: is swept twice; give all of its values at once (in the override run.seed=3)",
        ),
        ([], ["run.seed={1"], "run.seed: not valid YAML"),
        (["source.with.path=a.npy"], [], "source.with.path: the captures of a batch are given beside the spec"),
        ([], ["output.directory=a,b"], "output.directory: the folder of a batch is --output"),
    ],
)
def test_wrong_settings_are_refused(prepare: Callable[..., Batch], changes: list[str], swept: list[str], message: str) -> None:
    with pytest.raises(SpecError) as caught:
        prepare(changes=changes, swept=swept)
    [problem] = problems(caught)
    assert problem.startswith(message)


def test_source_without_a_file_is_refused(prepare: Callable[..., Batch]) -> None:
    with pytest.raises(SpecError, match=r"source\.use: this source reads no file or folder"):
        prepare({"version": 1, "source": {"use": "simulator"}})


def test_spec_with_poses_can_be_prepared(prepare: Callable[..., Batch]) -> None:
    pytest.importorskip("pycolmap")
    assert len(prepare({"version": 1, "source": {"use": "auto"}, "pose": {"use": "colmap-averages"}}).rows) == 2


def test_names_of_folders_are_safe_and_differ() -> None:
    names = [folder_name("cube", {"merge.with.file": value}) for value in ("a b", "a/b", "x" * 300, "x" * 301)]
    assert len({*names}) == 4
    assert all("/" not in name and " " not in name and len(name) < 200 for name in names)
    assert folder_name("cube", {"run.seed": 1, "levels.0.scale": 0.5}) == "cube,run.seed=1,levels.0.scale=0.5"
    assert folder_name("a b", {}) == "a b"
