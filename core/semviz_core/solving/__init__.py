"""Correspondences to poses, with honest uncertainty."""
