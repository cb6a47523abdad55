"""The benchmark: methods compared on the same problems."""
