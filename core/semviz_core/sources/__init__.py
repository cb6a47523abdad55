"""Images and priors in: real sequences and simulated ones."""
