"""A simulated street: its layout, its pictures, its detections."""
