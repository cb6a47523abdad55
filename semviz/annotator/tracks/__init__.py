"""The view "Tracks": every element in every frame, and edits of whole tracks."""
