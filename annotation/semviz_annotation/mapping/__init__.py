"""Labels to a map, and how good a map is."""
