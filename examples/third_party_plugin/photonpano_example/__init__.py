"""A plugin for photonpano: a merger and a locator."""
