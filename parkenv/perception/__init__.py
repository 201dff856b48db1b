"""Cars in images, and how far away they are (T §3.2)."""
