"""The session folder and its contents: rig file, images, records of captures.

`folder` reads a session and `writer` writes one, both with the typed records of `records` and the names of `names`;
`rig` checks ``rig.toml``; `images` decodes image files; `importing` creates a session from a folder of images;
`json_values` writes and reads arrays and dataclasses as JSON values.
"""
