"""Wrong poses: what images and labels say about them, and what people chose."""
