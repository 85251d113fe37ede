"""A gallery of bodies on different rigs of the virtual rig, measured at the defaults and compared with the truth.

``rows``        which body stands in which rig, and how it moves
``sample``      points of the true surface that cameras see, and whether a mesh covers them
``comparison``  errors of a run against the truth, beside the stated standard deviations
``picture``     the measured surface, coloured by its error, and what is missing
``tables``      the gallery's table as text, JSON and a page
``run``         from images to tables: ``ringdic validate --bodies``
"""

from ringdic_controller.studies.gallery.run import run_gallery

__all__ = ["run_gallery"]
