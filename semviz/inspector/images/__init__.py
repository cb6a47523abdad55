"""The image pane, and pictures of what a page shows."""
