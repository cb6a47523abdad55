"""Reports: what runs were, how good they are, and where they failed, as one file."""
