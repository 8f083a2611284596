"""Hooks of the plugin. Listing plugins imports this module, so it imports nothing heavy."""

from collections.abc import Iterator

from pydantic import Field

from photonpano import Config, Locator, LocatorContribution, Merger, MergerContribution, StageContext, hookimpl


class ShortExposureConfig(Config):
    """Keys of the merger, under `with` in a spec."""

    max_motion_px: float = Field(
        1.0,
        gt=0,
        le=16,
        description="frames are left out if a corner lies further than this from its place at the reference instant, in px",
    )


class ProfileShiftConfig(Config):
    """Keys of the locator, under `with` in a spec."""

    blur_px: float = Field(1.5, ge=0, le=10, description="standard deviation of the Gaussian blur against photon noise, in px")
    reach: float = Field(
        0.3,
        gt=0,
        le=0.5,
        description="search range around the motion known so far, as a fraction of the longer side",
    )


def build_short_exposure(config: ShortExposureConfig, context: StageContext) -> Merger:
    """Build the merger; heavy libraries are imported here, not before."""
    from photonpano_example.short_exposure import ShortExposure

    return ShortExposure(config.max_motion_px)


def build_profile_shift(config: ProfileShiftConfig, context: StageContext) -> Locator:
    """Build the locator."""
    from photonpano_example.profile_shift import ProfileShift

    return ProfileShift(config.blur_px, config.reach)


SHORT_EXPOSURE = MergerContribution(
    name="short-exposure",
    summary="Sums only the frames during which the camera hardly moved, without warping",
    config=ShortExposureConfig,
    build=build_short_exposure,
    api_version=1,
)
PROFILE_SHIFT = LocatorContribution(
    name="profile-shift",
    summary="The shift between the row profiles, and between the column profiles, of two exposures",
    config=ProfileShiftConfig,
    build=build_profile_shift,
    api_version=1,
)


@hookimpl
def photonpano_mergers() -> Iterator[MergerContribution]:
    """Offer the merger."""
    yield SHORT_EXPOSURE


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer the locator."""
    yield PROFILE_SHIFT
