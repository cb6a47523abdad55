"""The view "Filmstrip": proposals in the frames beside that on screen."""
