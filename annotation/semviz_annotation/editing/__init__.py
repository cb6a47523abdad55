"""What people can do to labels, each thing as a value that computes its row changes."""
