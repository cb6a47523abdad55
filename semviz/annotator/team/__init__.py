"""The view "Team": who has what, what waits for a reviewer, and frames labelled blind."""
