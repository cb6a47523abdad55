"""What is selected: in the matrix, in the run, in the labels."""
