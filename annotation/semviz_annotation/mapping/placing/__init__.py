"""Labels of many things as arrays, and their places in space."""
