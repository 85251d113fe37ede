"""The paper's experiments on the virtual rig, processed in the paper's way and in the most exact ("better") way.

``scenery``      the scenes of each experiment and the images taken of them
``image_cache``  renders each image once and keeps it
``folders``      session folders of rendered images
``experiments``  the sequence from images to figures
``calibration``  Tables 1 and 2, Fig. 6, exact lines of sight
``cylinder``     diameter, Fig. 7, the systematic errors separated
``limb``         Fig. 9, in undisturbed and in spoilt images
``figures``      a figure with its aim; ``report`` and ``plots`` show them
"""

from ringdic_controller.studies.validate.run import run_validation

__all__ = ["run_validation"]
