"""From a loaded bed to a crushed feed."""
