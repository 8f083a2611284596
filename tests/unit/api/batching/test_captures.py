from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import pytest

from photonpano import InputError, discover
from photonpano.api.batching.captures import find_captures

Find = Callable[..., dict[str, Path]]


@pytest.fixture
def find(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Find:
    """Find captures from a folder in which there are some; a folder with a file `is-capture` in it is one."""
    monkeypatch.chdir(tmp_path)
    for name in (
        "day/b.npy",
        "day/a.npy",
        "day/a.truth.npz",
        "day/notes.txt",
        "night/c.npy",
        "bins/is-capture",
        "bins/0.bin",
        "run/run.json",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "empty").mkdir()

    def find(*given: str | Path, lists: tuple[str, ...] = ()) -> dict[str, Path]:
        return find_captures(given, lists, discover(), lambda path: (path / "is-capture").exists())

    return find


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["day/a.npy", "night/c.npy"], {"a": "day/a.npy", "c": "night/c.npy"}),
        (["[br][iu]n*"], {"bins": "bins"}),
        (["day/*.np?"], {"a": "day/a.npy", "b": "day/b.npy"}),
        (["**/*.npy"], {"a": "day/a.npy", "b": "day/b.npy", "c": "night/c.npy"}),
        (["day"], {"a": "day/a.npy", "b": "day/b.npy"}),
        (["bins"], {"bins": "bins"}),
        (["."], {"bins": "bins"}),
        (["night/c.npy", "day/../night/c.npy", "night/*"], {"c": "night/c.npy"}),
        (["absent.npy"], {"absent": "absent.npy"}),
        (["day/b.npy", "old/b.c.npy.gz"], {"b": "day/b.npy", "b.c": "old/b.c.npy.gz"}),
        (["s3://day/b.npy", "s3://day/b.npy", "s3://night"], {"b": "s3://day/b.npy", "night": "s3://night"}),
        (["https://me:secret@host/c.npy.gz?key=secret"], {"c": "https://host/c.npy.gz"}),
    ],
    ids=lambda value: " ".join(value),
)
def test_captures_are_named_after_their_files(find: Find, given: list[str], named: dict[str, str]) -> None:
    assert {name: str(path) for name, path in find(*given).items()} == named
    assert list(find(*given)) == list(named)


def test_folder_that_is_given_by_dots_has_a_name(find: Find) -> None:
    Path("bins/frames").mkdir()
    assert list(find("bins/frames/..")) == ["bins"]


def test_file_whose_name_is_a_pattern_is_that_file(find: Find) -> None:
    Path("day/[ab].npy").touch()
    assert list(find("day/[ab].npy")) == ["[ab]"]


def test_list_counts_from_its_folder_and_may_have_comments(find: Find) -> None:
    Path("day/list.txt").write_text("# of Monday\n\n  a.npy  \n../night/*.npy\n", encoding="utf-8-sig")
    assert find(lists=("day/list.txt",)) == {"a": Path("day/a.npy"), "c": Path("day/../night/c.npy")}


def test_patterns_of_a_list_count_from_a_folder_whose_name_is_a_pattern(find: Find) -> None:
    Path("day").rename("day [1]")
    Path("day [1]/list.txt").write_text("*.npy\n", encoding="utf-8")
    assert list(find(lists=("day [1]/list.txt",))) == ["a", "b"]


def test_hidden_files_match_no_pattern(find: Find) -> None:
    Path("day/.c.npy").touch()
    assert list(find("day/*.npy")) == ["a", "b"]


def test_list_on_standard_input_counts_from_the_current_folder(find: Find, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("day/a.npy\n"))
    assert find(lists=("-",)) == {"a": Path("day/a.npy")}


def test_all_problems_come_at_once(find: Find) -> None:
    Path("bad.txt").write_text("day/a.npy\nday/*.h5\n", encoding="utf-8")
    Path("none.txt").write_text("# nothing\n", encoding="utf-8")
    Path("data.txt").write_bytes(b"\x93NUMPY\0")
    Path("latin.txt").write_bytes("n\xe4chtlich.npy".encode("latin-1"))
    Path("night/a.npy").touch()
    with pytest.raises(InputError) as caught:
        find(
            *("*.mat", "empty", "night", "a\0b", "caf\udce9", "s3://day/*.npy"),
            lists=("bad.txt", "none.txt", "data.txt", "latin.txt", "absent.txt"),
        )
    assert str(caught.value).splitlines() == [
        "nothing matches *.mat; check the pattern",
        "empty is no capture that the spec can read, and there is none in it; name the files",
        "'a\\x00b' contains the character NUL, which no path can; correct the path",
        "s3://day/*.npy is a pattern, and only files of this computer are matched; name each URL, as in a list",
        "bad.txt:2: nothing matches day/*.h5; check the pattern",
        "none.txt: the list names no capture; write one a line",
        "data.txt: not a list of captures, which is text; name captures as arguments",
        "latin.txt: the list is not UTF-8 text; save it as UTF-8, one capture a line",
        "absent.txt: the list of captures cannot be read: No such file or directory",
        "'caf\\udce9' is no text of UTF-8, which results cannot record; rename it",
        "two captures are called a, and would get one run folder: night/a.npy and day/a.npy; rename one of them, "
        "or run them in two batches",
    ]


def test_no_capture_is_refused(find: Find) -> None:
    with pytest.raises(InputError, match="no capture is given: name files, folders, or patterns in quotes"):
        find()
