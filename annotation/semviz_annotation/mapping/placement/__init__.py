"""Positions of many landmarks at once: triangulation, robust refinement, bundle adjustment.

`observations` collects labels as arrays. `linear` gives start positions, `reprojection` defines the
residuals and minimizes them, and `triangulation` finds the best positions over all views.
`landmarks` holds positions with covariance and fit. `bundle_adjustment` optimizes landmarks and
poses together.
"""
