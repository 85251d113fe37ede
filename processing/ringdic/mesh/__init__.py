"""Triangle meshes: neighbours, topology, distances along the surface, projection onto it."""
