"""The controller's side of the rig: the link to the nodes, capture rounds, and the intake of images."""
