"""Where the surface lies: start values between cameras and the region of interest."""
