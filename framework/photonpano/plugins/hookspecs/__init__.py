"""The extension points: one hook a kind, no arguments, each returns contributions; and hooks that watch runs.

A plugin is a module with these hooks, named in the entry-point group `photonpano` of its distribution:

    [project.entry-points.photonpano]
    my-plugin = "my_plugin.hooks"

The hook module imports no heavy library; the component does so when it is built. `examples/third_party_plugin` is such a
distribution, and `docs/tutorial/first-plugin.md` writes it step by step.
"""

from .levels import photonpano_interpolators as photonpano_interpolators
from .levels import photonpano_locators as photonpano_locators
from .levels import photonpano_mergers as photonpano_mergers
from .levels import photonpano_resamplers as photonpano_resamplers
from .observation import photonpano_run_finished as photonpano_run_finished
from .observation import photonpano_run_started as photonpano_run_started
from .observation import photonpano_stage_finished as photonpano_stage_finished
from .runs import photonpano_executors as photonpano_executors
from .runs import photonpano_exporters as photonpano_exporters
from .runs import photonpano_pose_estimators as photonpano_pose_estimators
from .runs import photonpano_refiners as photonpano_refiners
from .runs import photonpano_renderers as photonpano_renderers
from .runs import photonpano_sources as photonpano_sources
