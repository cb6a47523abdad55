"""The view "Map over time": changes of a map that the runs of several passes show."""
