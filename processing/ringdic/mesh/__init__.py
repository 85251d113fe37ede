"""Triangle meshes: adjacency, topology, geodesic distances, spatial search and projection onto a surface."""
