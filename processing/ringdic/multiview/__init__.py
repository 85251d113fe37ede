"""Measurement of one surface by all cameras together, where each material point is matched in all cameras that see it.

The surface is described by its radius over a lattice of angle and height about the target's axis.

At the reference:
``lattice`` is the lattice and the smooth pieces that are fitted to it, ``depth`` a first rough surface from sweeps of
the camera pairs, ``views`` the visibility of the lattice's nodes in the cameras, ``warps`` the deformation of a subset
between two cameras by the shape, ``matching`` the matches of the nodes, ``agreement`` their triangulation without
inconsistent views, ``weights`` the weights of the views, ``tube`` the triangles between the nodes, and
``shape`` all of these together.

In time:
``tracked_points`` and ``step_matching`` match points of one image in a later one of the same camera, ``tracking``
follows them through all images of a camera, ``motion`` triangulates the positions of every step from all cameras,
``uncertainty`` gives their standard deviations, and ``surface`` collects the results. ``tasks`` divides the work.
"""
