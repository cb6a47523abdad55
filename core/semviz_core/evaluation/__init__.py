"""How good localizations are."""
