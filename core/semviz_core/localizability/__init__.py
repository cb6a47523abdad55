"""Predict the localization error along a route from the map alone."""
