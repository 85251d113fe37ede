"""The main job on a simulated rig: node processes, a controller, captures over Zenoh, processing, the page.

``rig``         starts and stops the node processes and the controller
``client``      what an operator does, over HTTP
``comparison``  measured against true
"""

from ringdic_controller.studies.demo.run import run_demo

__all__ = ["run_demo"]
