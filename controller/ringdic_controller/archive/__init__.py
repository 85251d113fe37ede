"""The sessions on the disk, and the catalogue of them."""
