"""The 3D pane: map, cameras and what-if results."""
