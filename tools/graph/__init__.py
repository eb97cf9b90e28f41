"""The services of a cell and the keys between them, without running it; and as a picture."""
