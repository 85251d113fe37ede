"""Jobs divided into tasks with one output file each, so that a repeated job computes only missing outputs.

A task is a pure function of file paths and small values. Its output file lies in ``SESSION/work``, named by a key: a
digest of everything that the output depends on. A task whose output file exists is done. An executor runs the others:
`LocalExecutor` in threads of this process, other executors on other machines.

``task``         a task, its key and its output file
``agenda``       which tasks may start and which have ended
``local``        the executor of one machine
``memory``       the cache of a process between tasks: decoded images, prepared references
``step_images``  the images of a session as the tasks read them, and their digests
``work``         the folder of the output files, and the limit of its size
"""

from ringdic.tasks.agenda import Agenda
from ringdic.tasks.local import LocalExecutor
from ringdic.tasks.memory import Memory, process_memory
from ringdic.tasks.task import (
    Arrays,
    Executor,
    OnTaskEnd,
    Task,
    TaskReport,
    digest,
    file_digest,
    read_output,
)
from ringdic.tasks.work import tidy, work_folder

__all__ = [
    "Agenda",
    "Arrays",
    "Executor",
    "LocalExecutor",
    "Memory",
    "OnTaskEnd",
    "Task",
    "TaskReport",
    "digest",
    "file_digest",
    "process_memory",
    "read_output",
    "tidy",
    "work_folder",
]
