"""Camera calibration from images of a checkerboard and of a dotted cylinder (Solav et al. 2018, steps 0 and 1)."""
