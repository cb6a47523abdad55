"""What the 3D pane draws, part by part."""
