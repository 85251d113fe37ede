"""The rig as the controller sees it: the link to the nodes, capture rounds, and the intake of images."""
