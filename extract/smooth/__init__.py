"""Surfaces of smooth networks: proved errors of their polygons, and moving them onto the true level set."""
