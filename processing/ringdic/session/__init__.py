"""The session folder and what lies in it: rig file, images, records of captures.

`folder` reads a session and `writer` writes one, both by the typed records of `records` and the names of `names`; `rig`
checks ``rig.toml``; `images` decodes image files; `importing` makes a session of a folder of images.
"""
