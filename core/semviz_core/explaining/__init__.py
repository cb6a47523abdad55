"""What went wrong in a frame, and over a run, told from the method's own chain."""
