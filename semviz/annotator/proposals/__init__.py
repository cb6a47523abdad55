"""Proposals for unlabelled images: found in threads, selected, and described for the page."""
