"""The controller on the PC: rig, capture, archive, jobs, HTTP interface and page."""
