"""Jobs on a session: processing it as a whole, one step at once, in a warm process, or on a cluster of machines.

``pipeline``    from the session folder to the results
``summary``     the figures of a run
``run``         a finished run as an object: fields, drawings, measurements, exports
``live_step``   one step, while the capturing goes on
``serving``     a process with loaded kernels, which carries out one order after the other
``warm_up``     compiles the kernels that follow the matching
``allocation``  how the process asks the system for memory
``cluster``     tasks on more than one machine
"""
