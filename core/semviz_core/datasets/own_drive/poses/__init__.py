"""Poses of a drive: files and tables, and what their numbers mean."""
