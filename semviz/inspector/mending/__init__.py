"""From error to label: opened, mended, and the run made again."""
