"""From pictures to poses and maps of floors: the room that knows OpenCV."""
