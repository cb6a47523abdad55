"""What one image shows, to a fraction of a pixel: a pole's axis and its ends, a sign's outline."""
