"""Exact extraction: traversal of the IR, welding, meshes."""
