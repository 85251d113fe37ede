"""What the program says when something goes wrong in the laboratory: mishaps of the virtual rig, measured and judged.

``measurement``  the images of a calm measurement, and how a mishap changes them
``changes``      what a mishap does to images, cameras and the rig's description
``rows``         which mishap befalls which camera of which rig, and what the program should name
``judgement``    errors of a run against the truth, and whether the program followed, named or passed over the mishap
``tables``       the table as text, JSON and a page
``run``          from images to tables: ``ringdic validate --mishaps``
"""

from ringdic_controller.studies.mishaps.run import run_mishaps

__all__ = ["run_mishaps"]
