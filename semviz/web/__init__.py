"""What both web tools share: the front door, the 3D scene, the look."""
