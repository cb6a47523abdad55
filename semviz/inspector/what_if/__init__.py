"""What-if on the inspector's page."""
