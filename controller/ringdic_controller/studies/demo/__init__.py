"""The demo: a whole measurement with simulated cameras, from node processes and captures to results on the page.

``rig``         starts and stops the node processes and the controller
``client``      what an operator does, over HTTP
``comparison``  results compared with the truth
"""

from ringdic_controller.studies.demo.run import run_demo

__all__ = ["run_demo"]
