"""From an image to the poles and signs in it: a model finds regions, edges in them are measured."""
