"""What-if: frames of a run solved again with something changed, from the run file alone."""
