"""Checks of every contribution, whatever its kind."""

from __future__ import annotations

import importlib
import importlib.util
import json
import subprocess
import sys
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel, ValidationError

from photonpano.contracts.rules import BrokenContract
from photonpano.errors import PluginError
from photonpano.plugins.contributions import Contribution, install_command
from photonpano.plugins.registry import KINDS
from photonpano.plugins.registry.plugins import contributions_of

# Libraries that take long to import; numpy is allowed.
HEAVY = frozenset(
    {
        *("PIL", "av", "cupy", "cv2", "dask", "distributed", "h5py", "imageio", "jax", "kornia", "matplotlib", "numba"),
        *("pandas", "pycolmap", "scipy", "skimage", "sklearn", "tensorflow", "tifffile", "torch", "torchvision", "zarr"),
    }
)

_MODULES_OF = """
import importlib, importlib.util, json, runpy, sys
module, file, sys.path[:] = json.loads(sys.argv[1])
before = set(sys.modules)
try:
    found = importlib.util.find_spec(module)
except ModuleNotFoundError:
    found = None
if found:
    importlib.import_module(module)
else:
    runpy.run_path(file)
print(json.dumps(sorted({name.partition(".")[0] for name in set(sys.modules) - before})))
"""


@pytest.mark.usefixtures("photonpano_one_thread_inside")
class Conformance:
    """Checks of summaries, configs and imports. Subclasses for each kind add checks of its components.

    Attributes:
        contribution: the contribution under test; set it in a subclass.
        config: the keys under `with`. Set it on `self` in a fixture with `autouse=True` if it needs files.
        hook_module: the module that offers the contribution; by default the one in which its `build` is defined.
        heavy: top-level modules that must not be imported before a component is built, in addition to those that it requires.
    """

    kind: ClassVar[str]
    attributes: ClassVar[tuple[str, ...]] = ()

    contribution: Contribution
    config: Mapping[str, Any] = {}
    hook_module: str | None = None
    heavy: frozenset[str] = HEAVY

    def settings(self) -> Any:
        """Return the config under test."""
        return self.contribution.config.model_validate(dict(self.config))

    def require_libraries(self) -> None:
        """Skip a test if a library that the contribution requires is not installed."""
        for requirement in self.contribution.requires:
            if importlib.util.find_spec(requirement.module) is None:
                pytest.skip(f"{self.contribution.name} needs {requirement.module}: {install_command([requirement])}")

    def test_contribution_has_the_kind_of_this_class(self) -> None:
        """Specs look up components by kind."""
        wanted = KINDS[self.kind].contribution
        assert isinstance(self.contribution, wanted), (
            f"{type(self).__name__} tests a {self.kind}: contribution must be a {wanted.__name__}, "
            f"got {type(self.contribution).__name__}"
        )

    def test_summary_is_one_line_without_full_stop(self) -> None:
        """`photonpano plugins list` prints each on one line."""
        summary = self.contribution.summary
        assert summary == " ".join(summary.split()), f"the summary must be one line without spaces around it, got {summary!r}"
        assert summary, f"the summary of {self.contribution.name!r} is empty; describe the component in one line"
        assert not summary.endswith("."), f"the summary must not end with a full stop: {summary!r}"

    def test_config_is_closed_and_frozen(self) -> None:
        """A misspelt key is an error, and no component can modify a config that others share."""
        for model in models_in(self.contribution.config):
            extra, frozen = model.model_config.get("extra"), model.model_config.get("frozen")
            assert (extra, frozen) == ("forbid", True), (
                f"{model.__name__} must be closed and frozen: derive it from photonpano.Config; "
                f"its model_config has extra={extra!r}, frozen={frozen!r}"
            )

    def test_config_keys_have_descriptions(self) -> None:
        """Users see descriptions in `plugins show`, in messages and in editors."""
        missing = [
            f"{model.__name__}.{key}"
            for model in models_in(self.contribution.config)
            for key, field in model.model_fields.items()
            if not field.description
        ]
        assert not missing, (
            f"every key needs a description with its unit: add Field(..., description='...') to {', '.join(missing)}"
        )

    def test_config_refuses_unknown_key(self) -> None:
        """Typing errors are reported, not ignored."""
        try:
            self.contribution.config.model_validate({**self.config, "no-such-key": 1})
            problems = "nothing"
        except ValidationError as error:
            problems = ", ".join(f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors())
        assert problems == "no-such-key: Extra inputs are not permitted", (
            f"the config must refuse an unknown key, and accept the config under test; problems found: {problems}"
        )

    def test_config_survives_json_round_trip(self) -> None:
        """`run.json` contains the spec, from which a run can be repeated."""
        settings = self.settings()
        written = json.loads(json.dumps(settings.model_dump(mode="json")))
        again = must_not_raise(
            f"reading the config from the record {written}", self.contribution.config.model_validate, written
        )
        assert again == settings, (
            f"a config that is written as JSON must be read as the same config; {settings!r} was written as {written}, which "
            f"was read as {again!r}"
        )

    def test_hook_module_imports_no_heavy_library(self) -> None:
        """It is imported whenever plugins are listed; `build` imports libraries."""
        module = self.hook_module or self.contribution.build.__module__
        heavy = self.heavy | {requirement.module.partition(".")[0] for requirement in self.contribution.requires}
        imported = sorted(modules_of(module) & heavy)
        assert not imported, (
            f"importing {module} imports {', '.join(imported)}; move that import into the function `build`, or into a module "
            "that `build` imports"
        )

    def test_hooks_of_module_can_be_called(self) -> None:
        """A plugin whose hooks raise, or do not end, offers nothing."""
        name = self.hook_module or self.contribution.build.__module__
        module = sys.modules.get(name) or importlib.import_module(name)
        with passing(f"the hooks of {name}"):
            contributions_of(module)

    def require_methods(self, component: object) -> None:
        """Require the methods of the kind."""
        missing = [name for name in (*KINDS[self.kind].methods, *self.attributes) if not hasattr(component, name)]
        assert not missing, f"build() must return a {self.kind}; {type(component).__name__} has no {' and no '.join(missing)}"


def must_not_raise(what: str, work: Callable[..., Any], *arguments: Any) -> Any:
    """Call `work`; fail with a message if it raises."""
    try:
        return work(*arguments)
    except Exception as error:
        raise AssertionError(f"{what} must not raise; it raised {type(error).__name__}: {error}") from error


@contextmanager
def passing(what: str) -> Iterator[None]:
    """Fail with a message if a check of a run, called in the block, refuses what a component returned."""
    try:
        yield
    except (BrokenContract, PluginError) as error:
        raise AssertionError(f"a run refuses {what}: {error}") from error


def models_in(config: type[BaseModel]) -> list[type[BaseModel]]:
    """Return a config model and all models nested in it, each once."""
    found = [config]
    for model in found:  # grows meanwhile
        found += [each for field in model.model_fields.values() for each in _models(field.annotation) if each not in found]
    return found


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models(argument)


@cache
def modules_of(module: str) -> frozenset[str]:
    """Return the top-level modules that a fresh interpreter imports with a module; runs its file if it is on no path."""
    file = getattr(sys.modules.get(module), "__file__", None)
    argument = json.dumps([module, file, sys.path])
    done = subprocess.run([sys.executable, "-c", _MODULES_OF, argument], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (
        f"the hook module {module} cannot be imported in a fresh interpreter; set hook_module if the contribution comes from "
        f"another module:\n{done.stderr}"
    )
    return frozenset(json.loads(done.stdout.splitlines()[-1]))
