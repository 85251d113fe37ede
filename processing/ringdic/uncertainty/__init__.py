"""Standard deviations of matches, positions, displacements and stretches, due to image noise and to the calibration.

``noise``        variance of the noise of a camera's grey levels
``texture``      contrast and slopes of the grey levels over the subsets of an image
``matches``      standard deviations of matches by cause
``position``     standard deviations of triangulated positions from those of the pixels
``strain``       standard deviations of the stretches of triangles, with the correlation of overlapping subsets
``window``       standard deviations of stretches over a strain window
``calibration``  standard deviations due to the covariance of the camera parameters
"""
