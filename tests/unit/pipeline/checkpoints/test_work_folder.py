"""The work folder: what a run keeps of its results, and which of it the next run takes."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Located, parse_spec
from photonpano.execution.context import Quiet
from photonpano.pipeline.checkpoints.work_folder import (
    Continuation,
    Store,
    Work,
    differences,
    digest,
    path_of,
    run_fingerprint,
    work_folder,
)
from photonpano.record.schema import CaptureRecord

RESUMING = Continuation(resume=True)
LEVEL = {"scale": 1.0, "locate": {"use": "direct", "with": {"blur_px": 0.8}}, "code": {"photonpano_direct": "aa"}}


def fingerprint(**changes: Any) -> dict[str, Any]:
    """Return a fingerprint of a run of three levels; a change of `levels.2.scale` is written `levels__2__scale`."""
    found: dict[str, Any] = {
        "versions": {"photonpano": "0.1.0", "numpy": "2.4.6"},
        "code": {"photonpano": "aa"},
        "capture": {"files": [], "frames_sha256": "aa", "pixels_sha256": "aa"},
        "common": {"source": {"use": "packed-npy"}, "run.seed": 0},
        "levels": [LEVEL, LEVEL, LEVEL],
        "rest": {"render": {"scale": 1.0}},
    }
    found = json.loads(json.dumps(found))
    for path, value in changes.items():
        *keys, last = path.split("__")
        at = found
        for key in keys:
            at = at[int(key)] if isinstance(at, list) else at[key]
        at[last] = value
    return found


class Notes(Quiet):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, message: str) -> None:
        self.lines.append(message)


class Killed(BaseException):
    pass


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "scan"


@contextmanager
def working(
    place: Path, now: dict[str, Any] | None = None, how: Continuation | None = None, notes: Notes | None = None
) -> Iterator[Work]:
    with work_folder(place, now or fingerprint(), how or Continuation(), notes or Notes()) as work:
        yield work


def interrupt(place: Path, now: dict[str, Any] | None = None, levels: int = 1, notes: Notes | None = None, **how: Any) -> None:
    """Find `levels` levels and the motion of a refiner, and be interrupted."""
    with suppress(Killed), working(place, now, Continuation(**how), notes) as work:
        for level in range(1, levels + 1):
            log = work.checkpoints.log(f"level-{level}")
            log.add(level)
            log.finish()
        work.checkpoints.once("refined", lambda: 7)
        raise Killed


def found(work: Work) -> dict[str, Any]:
    """Return what is there."""
    logs = {f"level-{level}": work.checkpoints.log(f"level-{level}").found for level in (1, 2, 3)}
    computed: list[int] = []
    work.checkpoints.once("refined", lambda: computed.append(1))
    return {name: results for name, results in logs.items() if results} | ({} if computed else {"refined": True})


KEPT = {"level-1": [1], "refined": True}


@pytest.mark.parametrize(
    ("interrupted", "now", "how", "there", "note", "warning"),
    [
        (True, {}, RESUMING, KEPT, "going on with the interrupted run, from {work}", ""),
        (False, {}, RESUMING, {}, "there is no interrupted run to go on with: the run starts at the beginning", ""),
        (
            True,
            {},
            Continuation(),
            {},
            "",
            "{work} held the work of an interrupted run, which --resume would have continued; it is replaced",
        ),
        (
            True,
            {"rest__render__scale": 2.0},
            Continuation(),
            {},
            "{work} held the work of an interrupted run of something else; it is replaced",
            "",
        ),
    ],
    ids=["resumed", "nothing to resume", "not resumed", "something else"],
)
def test_interrupted_run_is_continued_or_replaced(
    place: Path,
    interrupted: bool,
    now: dict[str, Any],
    how: Continuation,
    there: dict[str, Any],
    note: str,
    warning: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    notes, work_path = Notes(), path_of(place)
    if interrupted:
        interrupt(place, notes=notes)
        assert notes.lines == [f"{work_path} holds what was found; with --resume, the run goes on from there"]
    notes.lines.clear()
    with working(place, fingerprint(**now), how, notes) as work:
        assert found(work) == there
    assert [*notes.lines, *caplog.messages] == [(note or warning).format(work=work_path)]
    assert len(caplog.messages) == bool(warning)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"versions__photonpano": "0.2.0"}, "the version of photonpano was 0.1.0 and is 0.2.0"),
        ({"code__photonpano": "bb"}, "the code of photonpano has changed"),
        ({"levels__0__code__photonpano_direct": "bb"}, "the code of photonpano_direct has changed"),
        ({"capture__frames_sha256": "bb"}, "the frames are others"),
        ({"common__run.seed": 1}, "run.seed was 0 and is 1"),
        ({"levels__1__locate__with__blur_px": 1.5}, "locate.with.blur_px was 0.8 and is 1.5 at level 2"),
        ({"levels": [LEVEL]}, "there were 3 levels and are 1"),
        ({"rest__render__scale": 2.0}, "render.scale was 1.0 and is 2.0"),
        (
            {"code__a": "b", "code__c": "d", "code__e": "f", "code__g": "h", "code__i": "j"},
            "the code of a has changed, the code of c has changed, the code of e has changed, and 2 more",
        ),
    ],
    ids=str,
)
def test_changed_run_starts_again_and_says_why(
    place: Path, change: dict[str, Any], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    interrupt(place)
    with working(place, fingerprint(**change), RESUMING) as work:
        assert found(work) == {}
    assert caplog.messages == [f"{path_of(place)}: the interrupted run is not continued, but started again: {reason}"]


def test_from_level_takes_the_levels_before_it_alone(place: Path) -> None:
    interrupt(place, levels=3)
    changed = fingerprint(levels__2__scale=2.0, rest__render__scale=2.0)
    with working(place, changed, Continuation(from_level=3)) as work:
        assert found(work) == {"level-1": [1], "level-2": [2]}
        work.finish()
    # The work is kept, so that more can be tried.
    with working(place, changed, Continuation(from_level=2)) as work:
        assert found(work) == {"level-1": [1]}


@pytest.mark.parametrize(
    ("levels", "from_level", "change", "message"),
    [
        (0, 2, {}, "--from-level 2: {work} holds no finished level; run without the option"),
        (1, 3, {}, "--from-level 3: {work} holds 1 finished level; expected 2"),
        (2, 4, {}, "--from-level 4: {work} holds 2 finished levels; expected 2 or 3"),
        (3, 5, {}, "--from-level 5: the spec has 3 levels; expected 2 to 4"),
        (3, 1, {}, "--from-level 1: the spec has 3 levels; expected 2 to 4"),
        (
            3,
            3,
            {"levels__1__scale": 2.0},
            "--from-level 3: the levels before it were found in another way: scale was 1.0 and is 2.0 at level 2; run without "
            "the option, or from an earlier level",
        ),
        (
            3,
            2,
            {"capture__frames_sha256": "bb"},
            "--from-level 2: the levels before it were found in another way: the frames are others; run without the option, or "
            "from an earlier level",
        ),
    ],
)
def test_from_level_without_such_levels_is_an_error_and_changes_nothing(
    place: Path, levels: int, from_level: int, change: dict[str, Any], message: str
) -> None:
    interrupt(place, levels=levels)
    with pytest.raises(InputError) as error, working(place, fingerprint(**change), Continuation(from_level=from_level)):
        pass
    assert str(error.value) == message.format(work=path_of(place))
    with working(place, how=RESUMING) as work:
        assert found(work) == {"refined": True} | {f"level-{each}": [each] for each in range(1, levels + 1)}


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_folder_of_somebody_else_is_left_alone(
    place: Path, tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    place.parent.mkdir()
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "thesis.tex").write_text("unique")
    if kind == "link":
        path_of(place).symlink_to(theirs)
    else:
        (theirs if kind == "folder" else theirs / "thesis.tex").rename(path_of(place))
    before = path_of(place).lstat()
    with working(place, how=RESUMING) as work:
        assert work.checkpoints.once("refined", lambda: 7) == 7
        work.finish()
    assert caplog.messages == [
        f"{path_of(place)}: what the run finds cannot be kept (it is there already, and is not the work folder of a run); if it"
        " is interrupted, all of it is computed again"
    ]
    assert (path_of(place).lstat().st_ino, path_of(place).lstat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert kind == "file" or [path.name for path in path_of(place).iterdir()] == ["thesis.tex"]


def test_folder_that_cannot_be_made_is_a_warning(
    place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuses(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuses)  # permissions do not bind root
    with working(place) as work:
        assert work.checkpoints.once("refined", lambda: 7) == 7
        work.finish()
    assert caplog.messages == [
        f"{path_of(place)}: what the run finds cannot be kept (Permission denied); if it is interrupted, all of it is computed "
        "again"
    ]


def test_digest_depends_on_every_value() -> None:
    groups = (Group(FrameSpan(0, 10), 4.5), Group(FrameSpan(10, 20), 14.5))
    homographies = np.random.default_rng(0).random((500, 3, 3))
    changed = homographies.copy()
    changed[400, 2, 1] = np.nextafter(changed[400, 2, 1], 1)
    given = [
        (groups, homographies),
        (groups[:1], homographies),
        (groups, changed),
        (groups, homographies.reshape(-1, 3)),
        (groups, homographies.astype(np.float32)),
        (groups, None),
        (homographies, groups),
    ]
    assert len({digest(*values) for values in given}) == len(given)
    assert digest(*given[0]) == digest(groups, homographies.copy())


VALUE = Located(np.random.default_rng(0).random((3, 3)), None, 0.25, {"matches": 7.0})


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def test_damaged_record_is_reported_and_computed_again(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    store.save("a", VALUE)
    path = store.folder / "a.pickle"
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    damages = [whole[: int(length)] for length in rng.integers(0, len(whole), 20)]
    for place, bit in zip(rng.integers(0, len(whole), 100), rng.integers(0, 8, 100), strict=True):
        damages.append(whole[:place] + bytes([whole[place] ^ (1 << bit)]) + whole[place + 1 :])
    for damaged in damages:
        path.write_bytes(damaged)
        caplog.clear()
        assert store.load("a") is None
        assert caplog.messages == [f"{path} is damaged, and is computed again"]
        assert not path.exists()


@contextmanager
def full_disk(monkeypatch: pytest.MonkeyPatch, free: int) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
        yield


def test_full_disk_is_one_warning_and_leaves_room_for_the_results(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with full_disk(monkeypatch, free=300):
        assert not store.save("a", VALUE)
        assert not store.save("b", VALUE)
    assert caplog.messages == [
        f"{store.folder}: what was found is not kept, as the 300 B free are for the results; the run goes on, but if it is "
        "interrupted, this is computed again"
    ]
    assert not store.holds_something
    assert list(store.folder.iterdir()) == []
    assert store.save("a", VALUE)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("run", {"seed": 1}),
        ("graph", {"skips": [1]}),
        ("source", {"use": "simulator", "with": {"flux": 0.7}}),
        ("levels", 3),
        ("motion", {"model": "homography"}),
        ("camera", {"focal_px": 500}),
    ],
    ids=["seed", "graph", "source", "levels", "motion", "camera"],
)
def test_fingerprint_tells_what_results_depend_on(key: str, value: object) -> None:
    spec = {"version": 1, "source": {"use": "simulator"}, "levels": 2}
    capture = CaptureRecord(files=[], frames_sha256="", pixels_sha256="")
    one, same, other = (
        run_fingerprint(parse_spec(each), capture, (8, 8))
        for each in (spec, spec | {"run": {"threads": 1}}, spec | {key: value})
    )
    assert differences(one, same) == []
    assert len(differences(one, other)) == 1
