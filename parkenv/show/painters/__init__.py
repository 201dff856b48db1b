"""Painters of the layers of a scene: on images (OpenCV) and on the axes of a figure (Matplotlib)."""
