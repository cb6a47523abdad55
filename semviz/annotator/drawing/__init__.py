"""What a person draws: guides, edges to snap to, and the element that it belongs to."""
