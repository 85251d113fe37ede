"""The paper's experiments on the virtual rig, beside the paper's figures: the paper's way and the better way.

``scenery``      what stands in the ring and which images it takes
``darkroom``     renders them once and keeps them
``folders``      session folders of them, in the form that captures and imports make
``experiments``  the line from images to findings
``calibration``  Tables 1 and 2, Fig. 6, exact lines of sight
``cylinder``     diameter, Fig. 7, the systematic errors apart
``limb``         Fig. 9, clean and spoilt
``figures``      one figure with its aim; ``report``, ``plots`` show them
"""

from ringdic_controller.studies.validate.run import run_validation

__all__ = ["run_validation"]
