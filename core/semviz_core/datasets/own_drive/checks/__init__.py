"""Checks of a drive by its own images: lines, matches, colours, and remedies for poses."""
