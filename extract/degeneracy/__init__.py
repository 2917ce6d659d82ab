"""Networks whose planes coincide or meet by design: how that is noticed, and meshes that are right all the same.

`perturb` brings a network into general position, and `limit` takes the mesh found there back to the network as it is.
`contract` (with `linked_mesh` and `walks`) makes vertices that coincide one and takes out polygons without area,
`box_copies` those that lie in a face of the box, and `flat` looks for regions where f is zero throughout.
"""
