"""Cameras with one small protocol: the Pi's, the simulated rig's, a test pattern, and images from files."""
