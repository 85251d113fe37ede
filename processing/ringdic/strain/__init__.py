"""From positions of a mesh to deformation: stretches, strains, and the rigid part of a motion."""
