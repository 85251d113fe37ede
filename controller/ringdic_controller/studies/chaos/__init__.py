"""A rig in chaos: nodes and controller are killed, frozen, doubled, their disks full, and nothing may be lost.

``plan``        what goes wrong in which capture, from a seed
``processes``   nodes and controller as processes that can be killed, frozen and started anew
``proxy``       links between nodes and controller that can be cut and slowed down
``controller``  the controller's process: captures without a page
``rogue``       somebody else on the network
``audit``       every image that a node had stored is archived once, everything else has its reason
``run``         from the plan to the audit: ``ringdic chaos``
"""

from ringdic_controller.studies.chaos.run import run_chaos

__all__ = ["run_chaos"]
