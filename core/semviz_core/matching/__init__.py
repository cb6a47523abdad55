"""Elements seen and mapped to correspondence probabilities."""
