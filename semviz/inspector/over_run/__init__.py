"""What is told of a whole run: its elements, its map's decisions, what its map foretells."""
