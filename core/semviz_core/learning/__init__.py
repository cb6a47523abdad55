"""Matchers that are learned: what they see, how they are trained, and how they answer."""
