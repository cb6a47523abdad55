"""Maps in other tools' formats; see docs/map-formats.md."""
