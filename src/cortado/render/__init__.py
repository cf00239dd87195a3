"""From particles to a picture and back: colour field on a grid, camera, image."""
