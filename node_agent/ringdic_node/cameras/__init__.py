"""Cameras behind one small protocol: the Pi's, the simulated rig's, and a plain test pattern."""
