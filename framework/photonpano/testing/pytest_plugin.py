"""Loaded by pytest wherever photonpano is installed: failed checks of the kit show the values that were compared.

Everybody's pytest imports this module, so it imports nothing but pytest.
"""

import pytest

for _name in ("conformance", "stages", "sources", "resamplers", "mergers", "locators", "interpolators"):
    pytest.register_assert_rewrite(f"photonpano.testing.{_name}")
