"""Whether a result is right: the import compared with other programs (`runtime`, `parity`), meshes with the field.

`residual` measures |f| on a mesh, `verification` any mesh file, and `findings` says what failed in an extraction.
"""
