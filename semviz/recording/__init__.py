"""Runs as rerun recordings: writing, reading, blueprint."""
