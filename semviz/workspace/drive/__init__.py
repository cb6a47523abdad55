"""What is known of an own drive: its file, and the checks of its import."""
