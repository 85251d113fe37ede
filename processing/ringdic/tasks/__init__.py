"""A job as a set of tasks, each with one output file, so that a job started again makes only what is missing.

A task is a pure function of file paths and small values. Its output lies in ``SESSION/work`` under a key of everything
that it depends on; where the file is there, the task is done. An executor runs those that are not: ``LocalExecutor``
in threads of this process, others elsewhere, all of them the same tasks.

``task``    a task, its key and its output file
``agenda``  which tasks may start and which have ended
``local``   the executor of one machine
``memory``  what a process keeps between tasks: decoded images, prepared references
``work``    the folder of the outputs, kept within a size
"""

from ringdic.tasks.agenda import Agenda
from ringdic.tasks.local import LocalExecutor, kernels_side_by_side
from ringdic.tasks.memory import Memory, kept
from ringdic.tasks.task import Arrays, Executor, Ran, Task, Told, code_stamp, digest, file_digest, read_output
from ringdic.tasks.work import tidy, work_folder

__all__ = [
    "Agenda",
    "Arrays",
    "Executor",
    "LocalExecutor",
    "Memory",
    "Ran",
    "Task",
    "Told",
    "code_stamp",
    "digest",
    "file_digest",
    "kept",
    "kernels_side_by_side",
    "read_output",
    "tidy",
    "work_folder",
]
