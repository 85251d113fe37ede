"""Camera model, lens distortion, triangulation of points from matched pixels, and tests for outliers."""
