"""Labels, stereo, triangulation and map building; no screen."""
