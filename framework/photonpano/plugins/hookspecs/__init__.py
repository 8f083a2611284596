"""The extension points: one hook a kind, no arguments, each returns contributions; and hooks that watch runs.

A plugin is a module with these hooks, named in the entry-point group `photonpano` of its distribution:

    [project.entry-points.photonpano]
    my-plugin = "my_plugin.hooks"

The hook module imports no heavy library; the component does so when it is built. `examples/third_party_plugin` is such a
distribution, and `docs/tutorial/first-plugin.md` writes it step by step.
"""

from photonpano.plugins.contributions import PROJECT, hookimpl, hookspec
from photonpano.plugins.hookspecs.levels import (
    photonpano_interpolators,
    photonpano_locators,
    photonpano_mergers,
    photonpano_resamplers,
)
from photonpano.plugins.hookspecs.observation import photonpano_run_finished, photonpano_run_started, photonpano_stage_finished
from photonpano.plugins.hookspecs.runs import (
    photonpano_executors,
    photonpano_exporters,
    photonpano_pose_estimators,
    photonpano_refiners,
    photonpano_renderers,
    photonpano_sources,
)

__all__ = [
    "PROJECT",
    "hookimpl",
    "hookspec",
    "photonpano_executors",
    "photonpano_exporters",
    "photonpano_interpolators",
    "photonpano_locators",
    "photonpano_mergers",
    "photonpano_pose_estimators",
    "photonpano_refiners",
    "photonpano_renderers",
    "photonpano_resamplers",
    "photonpano_run_finished",
    "photonpano_run_started",
    "photonpano_sources",
    "photonpano_stage_finished",
]
