"""What a run keeps of its results: records to the last bit, the store of them, and logs of results."""

import io
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, Panorama, parse_spec
from photonpano.motion.diagnosis import Contrast
from photonpano.motion.registration import Registered
from photonpano.motion.tracking import Place
from photonpano.pipeline.checkpoints.fingerprint import differences, run_fingerprint
from photonpano.pipeline.checkpoints.records import digest, packed, unpacked
from photonpano.pipeline.checkpoints.store import Kept, Store, finished
from photonpano.record.fingerprint import CaptureRecord
from photonpano.values import Decision, Edge

RNG = np.random.default_rng(0)


def located(evidence: Any = None) -> Located:
    return Located(RNG.random((3, 3)), RNG.random((8, 8)), 0.1 + 0.2, {} if evidence is None else evidence)


def read_back(value: Any) -> Any:
    stream = io.BytesIO()
    np.savez(stream, **packed(value))
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as archive:
        return unpacked(dict(archive))


def require_same(first: Any, second: Any) -> None:
    """Compare to the last bit: the packed form holds everything."""
    one, other = packed(first), packed(second)
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].dtype == other[name].dtype
        assert one[name].tobytes() == other[name].tobytes()


@pytest.mark.parametrize(
    "value",
    [
        None,
        (1, 2.5, "µ", True, math.inf, -0.0, 5e-324, 2**70),
        {"a": 1, (0, 1): 2.0},
        Edge(4, 3, located({"matches": 12, "share": 0.1}), "direct"),
        Edge(4, 3, NotLocated("too little overlap", {"overlap": math.nan})),
        Registered((Edge(1, 0, located(), "direct"),), Contrast(3.2), Place(0, RNG.random((3, 3)), RNG.random(2)), {0: 12.5}),
        Registered((), Contrast(0.0, "no pixel was seen"), None, {}),
        Panorama(RNG.random((80, 90)).astype(np.float32), np.zeros((80, 90), np.float32), np.eye(3)),
        Decision("group_size", 50, "as it is"),
        FrameSpan(3, 9),
    ],
    ids=lambda value: type(value).__name__,
)
def test_value_comes_back_to_the_last_bit(value: Any) -> None:
    require_same(read_back(value), value)


@pytest.mark.parametrize(
    "array", [np.zeros((0, 3)), np.float32([[1, np.nan]]), np.arange(9000), np.array(True), np.ones((5, 4)).T]
)
def test_array_keeps_type_shape_and_values(array: np.ndarray) -> None:
    found = read_back((array, "x", array))[0]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array, strict=True)


def test_numbers_of_plugins_become_plain_ones() -> None:
    found = read_back(NotLocated("dark", {"a": np.float32(0.1), "b": np.int64(3), "c": Fraction(1, 4), "d": np.bool_(True)}))
    assert found.evidence == {"a": float(np.float32(0.1)), "b": 3, "c": 0.25, "d": True}


@pytest.mark.parametrize("value", [{1, 2}, np.array([None]), np.array([1j]), 1j, Path("/"), np.array(["text"])])
def test_anything_else_cannot_be_kept(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be kept"):
        packed(value)


def test_digest_depends_on_every_value() -> None:
    groups = (Group(FrameSpan(0, 10), 4.5), Group(FrameSpan(10, 20), 14.5))
    homographies = RNG.random((500, 3, 3))
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


def test_store_returns_what_was_saved(store: Store) -> None:
    assert not store.holds_something
    assert store.save("a.1", VALUE)
    assert store.load("a.1").homography.tobytes() == VALUE.homography.tobytes()
    assert store.load("a.2") is None
    assert store.names("a.") == ["a.1"]
    assert Store(store.folder).holds_something


def test_damaged_record_is_reported_or_reads_the_same(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    store.save("a", VALUE)
    path = store.folder / "a.npz"
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    damages = [whole[: int(length)] for length in rng.integers(0, len(whole), 60)]
    for place, bit in zip(rng.integers(0, len(whole), 400), rng.integers(0, 8, 400), strict=True):
        damages.append(whole[:place] + bytes([whole[place] ^ (1 << bit)]) + whole[place + 1 :])
    n_damaged = 0
    for damaged in damages:
        path.write_bytes(damaged)
        caplog.clear()
        found = store.load("a")
        if found is None:
            n_damaged += 1
            assert f"{path} is damaged (" in caplog.text
            assert not path.exists()
        else:  # the bit is one that nothing depends on, such as that of a date
            assert found.homography.tobytes() == VALUE.homography.tobytes()
            assert (found.information, found.residual_px, found.evidence) == (None, 0.25, {"matches": 7.0})
    assert n_damaged > 300


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


def test_error_while_writing_is_a_warning(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(np, "savez", fails)
    assert not store.save("a", VALUE)
    assert caplog.messages == [
        f"cannot write {store.folder}/a.npz: No space left on device; free some space or choose another folder; the run goes "
        "on, but if it is interrupted, this is computed again"
    ]
    assert list(store.folder.iterdir()) == []


def test_once_computes_a_result_once_and_repeats_its_decisions(store: Store) -> None:
    calls, decisions = [], []

    def compute() -> Located:
        calls.append(1)
        decisions.append(Decision("chunks", 3, "short"))
        return VALUE

    kept = Kept(store, decisions)
    given = np.eye(3), "x"
    for _ in range(2):
        assert kept.once("step", compute, *given).residual_px == VALUE.residual_px
    assert len(calls) == 1
    assert decisions == 2 * [Decision("chunks", 3, "short")]
    kept.once("step", compute, np.eye(3), "y")
    kept.once("other", compute, *given)
    kept.within("vignette").once("step", compute, *given)
    assert len(calls) == 4
    for _ in range(2):
        assert kept.once("nothing", lambda: calls.append(1)) is None
    assert len(calls) == 5


@pytest.fixture
def written_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photonpano.pipeline.checkpoints.store.FLUSH_S", 0.0)


def test_log_goes_on_after_the_last_result_that_was_written(store: Store, written_at_once: None) -> None:
    log = Kept(store, []).log("level-1", "given")
    for number in range(5):
        log.add(number)
    again = Kept(store, []).log("level-1", "given")
    assert again.found == [0, 1, 2, 3, 4]
    again.add(5)
    assert Kept(store, []).log("level-1", "given").found == [0, 1, 2, 3, 4, 5]
    assert Kept(store, []).log("level-1", "other").found == []
    assert Kept(store, []).log("level-1-revisits", "given").found == []
    assert not finished(store, "level-1")
    again.finish()
    assert finished(store, "level-1")


def test_log_waits_between_files_until_it_is_flushed(store: Store) -> None:
    kept = Kept(store, [])
    log = kept.log("level-1")
    log.add(0)
    log.add(1)
    assert Kept(store, []).log("level-1").found == []
    kept.flush()
    assert Kept(store, []).log("level-1").found == [0, 1]
    assert len(store.names("level-1")) == 1


def test_log_ends_before_a_damaged_file(store: Store, written_at_once: None, caplog: pytest.LogCaptureFixture) -> None:
    log = Kept(store, []).log("level-1")
    for number in range(4):
        log.add(number)
    (store.folder / f"{store.names('level-1')[2]}.npz").write_bytes(b"nonsense")
    log = Kept(store, []).log("level-1")
    assert log.found == [0, 1]
    assert "is damaged" in caplog.text
    log.add(2)
    # What comes after it was found from the same results, and is still right.
    assert Kept(store, []).log("level-1").found == [0, 1, 2, 3]


def test_log_repeats_decisions_unless_they_are_taken_again(store: Store, written_at_once: None) -> None:
    first, second = Decision("chunk_frames", 3, "short"), Decision("other", 1, "why")
    decisions: list[Decision] = []
    log = Kept(store, decisions).log("level-1")
    decisions += [first, second]
    log.add(0)
    later: list[Decision] = [Decision("source", "npy", "suffix")]
    log = Kept(store, later).log("level-1")
    later.append(first)
    log.finish()
    assert later[1:] == [first, second]


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
