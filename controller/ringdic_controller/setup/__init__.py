"""Setting a rig up: the files of all its machines, and what is wrong with them."""
