"""Localization in sparse semantic maps: values, sources, solvers, evaluation."""
