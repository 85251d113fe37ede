"""The cameras found from images of a checkerboard and of the dotted cylinder (Solav et al. 2018, steps 0 and 1)."""
