"""Run the documentation: its code, its specs, and its commands with the output shown."""

from __future__ import annotations

import contextlib
import doctest
import importlib.util
import io
import itertools
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from photonpano import parse_spec
from photonpano.api.cli import progress as cli_progress
from photonpano.api.cli.app import app
from photonpano.capture.writing import truth_path

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").glob("*/README.md")),
]
BLOCK = re.compile(
    r"(?:^<!-- (?P<marker>(?:test|file):[^\n]*?) *-->\n+)?^```(?P<language>\w+)\n(?P<text>.*?)^```$"
    r"|^<!-- test: setup\n(?P<setup>.*?)^-->$",
    re.MULTILINE | re.DOTALL,
)

NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?")
ASSIGNMENT = re.compile(r"[A-Z0-9_]+=")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page. A comment before the fence says what the tests do with it:

    <!-- file: NAME -->         it is that file, for the blocks after it
    <!-- test: fragment -->     YAML that is a part of a spec
    <!-- test: needs LIBRARY -->  a fragment that is checked where the library is installed
    <!-- test: parse -->        commands that are parsed and not run
    <!-- test: with ARGS -->    commands that are run with more arguments, so that they print something else
    <!-- test: near -->         commands that print the same words and nearly the same numbers, as processors round differently
    <!-- test: setup ... -->    Python that prepares the blocks after it, and that readers need not see; it compares figures of
                                the text with measured ones by `figures("{} px at level 2", measured)`
    """

    page: Path
    line: int
    language: str
    text: str
    marker: str = ""

    def argument(self, name: str) -> str | None:
        """Return the text after a marker."""
        return self.marker.removeprefix(name).strip() if self.marker.startswith(name) else None

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    blocks = []
    for match in BLOCK.finditer(text):
        group = "text" if match["setup"] is None else "setup"
        line = text.count("\n", 0, match.start(group))
        blocks.append(Block(page, line, match["language"] or "python", match[group], match["marker"] or ""))
    return blocks


def commands_of(block: Block) -> Iterator[tuple[list[str], str]]:
    """Yield the words of each command, and the output shown on the page."""
    for part in re.split(r"^\$ ", block.text.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
        line, _, output = part.partition("\n")
        yield shlex.split(line, comments=True), output


def ident(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="session")
def captures(simulated, small_capture) -> dict[str, Callable[[str], None]]:
    """What puts a capture and its truth into the current folder, by name: `make_capture("capture.npy")`.

    Runs of the first take half as long: 200 frames of 80x112 px on a steady pan.
    """
    steady = simulated(n_frames=200, frame_shape=[80, 112], path={"kind": "pan", "length_px": 40, "angle_deg": 10})

    def copy(capture: Path, name: str) -> None:
        shutil.copy(capture, name)
        shutil.copy(truth_path(capture), truth_path(Path(name)))

    return {"make_capture": partial(copy, steady), "make_trembling_capture": partial(copy, small_capture)}


@pytest.fixture
def workplace(tmp_path, monkeypatch) -> Path:
    """A new folder from which modules are imported and plugins discovered."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    forget_modules(tmp_path)


def forget_modules(folder: Path) -> None:
    """Forget the imported modules of a folder."""
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(folder)):
            del sys.modules[name]
    importlib.invalidate_caches()


def number(text: str) -> float:
    return float(text.replace(",", ""))


def near(shown: str) -> Any:
    """Return what equals a number that a page shows to a quarter of it, or to two units of its last digit."""
    return pytest.approx(number(shown), rel=0.25, abs=2 * 10.0 ** -len(shown.partition(".")[2]))


def compare_figures(page: Path, sentence: str, *measured: float) -> None:
    """Compare the figures of a sentence of a page with measured ones; `{}` stands for each."""
    words = [re.escape(part).replace(r"\ ", r"\s+") for part in sentence.split("{}")]
    found = re.search(f"({NUMBER.pattern})".join(words), page.read_text(encoding="utf-8"))
    assert found, f"{page}: {sentence}"
    assert all(value == near(shown) for value, shown in zip(measured, found.groups(), strict=True)), f"{found[0]}: {measured}"


class Reader:
    """Follows a page block by block, as a reader does."""

    def __init__(self, workplace: Path, names: dict[str, Any]) -> None:
        self.workplace = workplace
        self.names = names

    def follow(self, block: Block) -> None:
        if file := block.argument("file:"):
            path = self.workplace / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
            forget_modules(self.workplace)
        if block.language == "yaml":
            self.check_spec(block)
        elif block.language == "python" and not file:
            self.run_python(block)
        elif block.language == "console":
            for words, output in commands_of(block):
                self.run_command(block, words, output)

    def check_spec(self, block: Block) -> None:
        text: Any = block.text
        library = block.argument("test: needs")
        if library and importlib.util.find_spec(library) is None:
            return
        if library or block.marker == "test: fragment":
            text = {"version": 1, "source": {"use": "simulator"}, **YAML(typ="safe").load(block.text)}
        parse_spec(text, directory=self.workplace)

    def run_python(self, block: Block) -> None:
        if ">>>" in block.text:
            test = doctest.DocTestParser().get_doctest(block.text, self.names, str(block), str(block.page), block.line)
            report: list[str] = []
            doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=report.append, clear_globs=False)
            assert not report, "".join(report)
            self.names.update(test.globs)
        else:
            source = self.workplace / f".{block.page.name}"  # numba keeps machine code beside the source of a loop
            shutil.copy(block.page, source)
            exec(compile("\n" * block.line + block.text, str(source), "exec"), self.names)

    def run_command(self, block: Block, words: list[str], shown: str) -> None:
        environment = dict(word.split("=", 1) for word in itertools.takewhile(ASSIGNMENT.match, words))
        words = words[len(environment) :]
        match words:
            case ["photonpano", *arguments]:
                pass
            case ["pip", "install", "-e", "."]:
                return self.install()
            case ["make", target]:
                assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), f"{block}: make {target}"
                return None
            case ["git" | "pip" | "cd", *_] | ["python3", "-m", *_]:
                return None
            case ["pytest", *arguments]:
                return self.run_pytest(block, arguments, shown)
            case ["python", "-m", module, *arguments]:
                return self.run_module(block, module, arguments, shown)
            case ["python", script, *_]:
                assert (ROOT / script).is_file(), f"{block}: {script}"
                return None
            case _:
                pytest.fail(f"{block}: no rule for {words}")
        arguments, target = (arguments[:-2], arguments[-1]) if ">" in arguments else (arguments, None)
        more = "--help" if block.marker == "test: parse" else block.argument("test: with")
        done = CliRunner().invoke(app, arguments + shlex.split(more or ""), env=environment, prog_name="photonpano")
        fails = "error:" in shown
        assert (done.exit_code != 0) == fails, f"{block}: {words}\n{done.output}\n{done.exception!r}"
        if target is not None:
            (self.workplace / target).write_text(done.stdout, encoding="utf-8")
        elif shown.strip() and block.marker == "test: near":
            self.compare_nearly(block, done.output.replace(str(self.workplace.resolve()), "/home/you"), shown)
        elif shown.strip() and more is None:
            self.compare(block, words, done.output, shown)
        return None

    def run_pytest(self, block: Block, arguments: list[str], shown: str) -> None:
        more = block.argument("test: with")
        added = ["-p", "no:cacheprovider", "--rootdir", str(self.workplace), *shlex.split(more or "")]
        command = [sys.executable, "-m", "pytest", *added, *arguments]
        done = subprocess.run(command, cwd=self.workplace, capture_output=True, text=True, check=False)
        if more is None:
            self.compare(block, arguments, done.stdout, shown)
        else:
            assert done.returncode == 0, f"{block}: {arguments}\n{done.stdout}"

    def run_module(self, block: Block, module: str, arguments: list[str], shown: str) -> None:
        """Run a module of the repository, which pages run in its root."""
        more = ["--help"] if block.marker == "test: parse" else []
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
            patch.syspath_prepend(ROOT)
            patch.setattr(sys, "argv", [module, *arguments, *more])
            code: Any = 0
            try:
                runpy.run_module(module, run_name="__main__")
            except SystemExit as ended:
                code = ended.code
        assert not code, f"{block}: {module}\n{printed.getvalue()}"
        if not more:
            self.compare(block, [module, *arguments], printed.getvalue(), shown)

    def compare(self, block: Block, words: list[str], printed: str, shown: str) -> None:
        flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
        same = doctest.OutputChecker().check_output(f"{shown.strip()}\n", f"{printed.strip()}\n", flags)
        assert same, f"{block}: {words} printed\n{printed}\nand the page shows\n{shown}"

    def compare_nearly(self, block: Block, printed: str, shown: str) -> None:
        """Compare words, and numbers as `near` does."""
        said = f"{block} printed\n{printed}\nand the page shows\n{shown}"
        assert re.sub(NUMBER, "#", printed).split() == re.sub(NUMBER, "#", shown).split(), said
        for got, text in zip(re.findall(NUMBER, printed), re.findall(NUMBER, shown), strict=True):
            assert number(got) == near(text), f"{got} for {text}: {said}"

    def install(self) -> None:
        """Write the metadata that pip would install, beside the modules of the project."""
        project = tomllib.loads((self.workplace / "pyproject.toml").read_text())["project"]
        info = self.workplace / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
        points = project["entry-points"]["photonpano"]
        (info / "entry_points.txt").write_text("[photonpano]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()))
        importlib.invalidate_caches()


@pytest.mark.documentation
@pytest.mark.parametrize("page", PAGES, ids=ident)
@pytest.mark.usefixtures("without_report")
def test_code_and_commands_of_page_work(page, workplace, captures, monkeypatch):
    # Pages do not show the lines that long commands print as they go on, and on a busy machine any command is long.
    monkeypatch.setattr(cli_progress, "INTERVAL_S", 3600.0)
    reader = Reader(workplace, {**captures, "figures": partial(compare_figures, page)})
    for block in blocks_of(page):
        try:
            reader.follow(block)
        except Exception as error:
            raise AssertionError(f"{block}: {type(error).__name__}: {error}") from error


@pytest.mark.parametrize("page", PAGES, ids=ident)
def test_every_block_of_page_is_tested(page):
    fences = re.findall(r"^ *```", page.read_text(encoding="utf-8"), re.MULTILINE)
    shown = [block for block in blocks_of(page) if block.text in page.read_text(encoding="utf-8")]
    hidden = page.read_text(encoding="utf-8").count("<!-- test: setup")
    assert len(fences) == 2 * (len(shown) - hidden)
    assert {block.language for block in shown} <= {"python", "yaml", "console", "toml", "text"}


@pytest.mark.parametrize("page", PAGES, ids=ident)
def test_links_and_pictures_of_page_exist(page):
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"", text):
        path, _, anchor = "".join(target).partition("#")
        if path.startswith(("http://", "https://")):
            continue
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page}: {path}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", file.read_text(encoding="utf-8")), re.MULTILINE)
            assert anchor in map(slug, headings), f"{page}: {path}#{anchor}"


def slug(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_plugin_tutorial_ends_with_example_files():
    """The last version of each file block equals the file of the example; only the README has no block."""
    example = ROOT / "examples" / "third_party_plugin"
    written = {}
    for block in blocks_of(ROOT / "docs" / "tutorial" / "first-plugin.md"):
        if file := block.argument("file:"):
            written[file] = block.text
    kept = [path for pattern in ("*.toml", "*.yaml", "*/*.py") for path in example.glob(pattern)]
    assert written == {path.relative_to(example).as_posix(): path.read_text(encoding="utf-8") for path in kept}


def test_index_links_every_page():
    index = ROOT / "docs" / "README.md"
    linked = {(index.parent / target).resolve() for target in re.findall(r"\]\(([^)#]+)", index.read_text(encoding="utf-8"))}
    assert set((ROOT / "docs").rglob("*.md")) - {index} <= linked
