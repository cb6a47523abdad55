"""What tests and benches share: simulated labels, and frames and drives with a planted fault."""
