"""The session folder and what lies in it: the rig file, the images, the records of captures."""
