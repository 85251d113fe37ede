"""Simulated ring of cameras about bodies of known shape and motion: rendered images with exact truth.

The renderer is an independent check of the processing and shares no camera mathematics with it. Conventions are the
same: mm, z up the axis of the target, pixel (0, 0) at the centre of the top-left pixel, cameras look along +z.

``rig``       the cameras of the paper's ring, of an arc and of two rows, scattered as real ones are
``lens``      one camera: pose, intrinsics with skew, distortion and its inverse
``scenes``    what stands in the ring: board, target, cylinder, limb, each with its truth
``solid``     solid bodies of any form as implicit functions, with their motion; ``bodies`` names some
``texture``   speckles, dots and digits as distances in surface coordinates, averaged over a pixel's footprint
``render``    rays from pixels to surfaces; ``solid_render`` to solid bodies, ``room`` what is behind them
``disturbance``  cameras that were knocked or refocused, images taken otherwise
``sensor``    point spread, vignetting, noise, gamma, 8 bits
``folder``    a whole measurement rendered into a folder of images: ``python -m ringdic_node.virtual_rig FOLDER``
"""
