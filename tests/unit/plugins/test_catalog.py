"""Looking components up."""

from dataclasses import replace
from types import ModuleType

import pytest

from photonpano import Config, LocatorContribution, MergerContribution, PluginError, Requirement
from photonpano.plugins.registry import BrokenPlugin, Catalog, DisabledPlugin, Origin


class Keys(Config):
    pass


def unbuilt(config, context):
    raise AssertionError


def locator(name, *requires):
    return LocatorContribution(name=name, summary="A toy", config=Keys, build=unbuilt, requires=requires)


MERGER = MergerContribution(name="sum", summary="A toy", config=Keys, build=unbuilt)
KORNIA = Requirement("no_such_kornia", "photonpano[kornia]")


@pytest.fixture
def catalog():
    return Catalog().including(locator("opencv-sift"), locator("direct"), MERGER)


def message(catalog, kind, name):
    with pytest.raises(PluginError) as caught:
        catalog.find(kind, name)
    return str(caught.value)


def test_including_a_broken_plugin_is_an_error():
    plugin = ModuleType("my_hooks")
    plugin.photonpano_mergers = lambda: [MERGER]
    with pytest.raises(PluginError, match=r"^photonpano_mergers is not marked with @photonpano\.hookimpl$"):
        Catalog().including(plugin)


def test_including_a_contribution_for_another_contract_is_an_error():
    with pytest.raises(PluginError) as caught:
        Catalog().including(replace(MERGER, api_version=7))
    assert str(caught.value) == (
        "the merger 'sum' was made for version 7 of the plugin contract, and this photonpano has version 1; upgrade photonpano"
    )


@pytest.mark.parametrize(
    ("kind", "name", "expected"),
    [
        ("locator", "opencv-sfit", "there is no locator 'opencv-sfit'; did you mean 'opencv-sift'?"),
        ("locator", "Opencv_Sift", "there is no locator 'Opencv_Sift'; did you mean 'opencv-sift'?"),
        ("locator", "sift", "there is no locator 'sift'; did you mean 'opencv-sift'?"),
        ("locator", "shift", "there is no locator 'shift'; did you mean 'opencv-sift'?"),
        ("locator", "loftr", "there is no locator 'loftr'; known: direct and opencv-sift"),
        ("locator", "sum", "there is no locator 'sum'; it is one of the mergers"),
        ("source", "cube", "there is no source 'cube'"),
    ],
)
def test_unknown_name_suggests_nearest_names(kind, name, expected, catalog):
    assert message(catalog, kind, name) == expected


A, B = Origin("a", "1", "a = a.hooks"), Origin("b", "2", "b = b.hooks")


@pytest.mark.parametrize(
    ("catalog", "expected"),
    [
        (
            Catalog(broken=(BrokenPlugin(A, "ImportError: x"), BrokenPlugin(B, "ValueError: y"))),
            "Broken plugins may have offered it: a 1 (a = a.hooks): ImportError: x and b 2 (b = b.hooks): ValueError: y",
        ),
        (
            Catalog(disabled=(DisabledPlugin(A, "X=a"),)),
            "Disabled plugins may have offered it: a 1 (a = a.hooks), by X=a",
        ),
    ],
)
def test_unknown_name_mentions_plugins_that_offer_nothing(catalog, expected):
    assert message(catalog, "source", "cube") == f"there is no source 'cube'. {expected}"
    assert message(catalog.including(locator("cubes")), "locator", "cub") == (
        f"there is no locator 'cub'; did you mean 'cubes'? {expected}"
    )


def test_missing_library_names_extra_for_index_and_checkout():
    catalog = Catalog().including(locator("loftr", KORNIA), locator("both", KORNIA, Requirement("no.such.module", "other>=2")))
    assert catalog.find("locator", "loftr").unavailable == (
        "the locator 'loftr' needs no_such_kornia, which is not installed: "
        'pip install "photonpano[kornia]" (in a checkout: pip install ".[kornia]")'
    )
    assert catalog.find("locator", "both").unavailable == (
        "the locator 'both' needs no_such_kornia and no.such.module, which are not installed: "
        'pip install "photonpano[kornia]" "other>=2" (in a checkout: pip install ".[kornia]" "other>=2")'
    )
    assert catalog.find("locator", "loftr").missing == (KORNIA,)
