"""Maps of a workspace: their review, decisions on changes, and the backdrop."""
