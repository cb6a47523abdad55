"""One command for all drives of a collection, on the machines of a Ray cluster."""
