"""Two runs of one drive compared, and gates on the outcome."""
