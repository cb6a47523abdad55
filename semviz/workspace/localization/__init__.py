"""Localize the frames of a workspace, and record runs."""
