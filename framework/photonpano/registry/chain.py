"""`chain-of-backends`: a name for several locators, which the framework resolves into a locator and its fallbacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import Field

from photonpano.contributions import Config, LocatorContribution
from photonpano.errors import PluginError

if TYPE_CHECKING:
    from photonpano.contributions import StageContext
    from photonpano.protocols import Locator


class ChainConfig(Config):
    """Several locators, in the order in which they are tried."""

    backends: tuple[str | dict[str, Any], ...] = Field(
        ("direct", "opencv-sift"),
        min_length=1,
        description="the locators, in the order in which they are tried: each is a name, or a mapping of use and with",
    )


def _build(config: ChainConfig, context: StageContext) -> Locator:
    del config, context
    raise PluginError(f"{CHAIN.name} stands for other locators: build these, as specs that name it do")


CHAIN = LocatorContribution(
    name="chain-of-backends",
    summary="Several locators in order, each for the pairs that those before it lost",
    config=ChainConfig,
    build=_build,
)
"""What the framework itself offers. A spec that uses it is resolved into the first of the locators, and the others as its
fallbacks, so that nothing is ever built of it."""
