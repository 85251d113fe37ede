"""One surface seen by all cameras: every material point has one identity in all of them.

The surface is a radius over a lattice of angle and height about the target's axis. ``lattice`` lays the lattice and
fits smooth pieces to it, ``depth`` finds it roughly, ``views`` says which camera sees a node, ``warps`` what the shape
does to a subset between two cameras, ``shape`` joins these to the reference shape, ``tube`` lays the triangles.
In time, ``following`` finds points of one image again in another of the same camera, ``tracking`` does so through all
of a camera's images, and ``motion`` places the points from all cameras at every step.
"""
