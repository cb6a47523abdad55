"""What a map lets a camera know of its place, before any camera has been there."""
