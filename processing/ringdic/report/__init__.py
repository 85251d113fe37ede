"""One self-contained HTML page of a processing run: what was measured, with what, how well; for archives and readers.

It fetches nothing: styles and pictures are inside. ``document`` is the HTML, ``hardware`` measures what the images tell
of cameras and pattern, ``tables`` are the reporting tables, ``noise`` the noise floor, ``plots`` the drawings.
"""

from ringdic.report.report import write_report

__all__ = ["write_report"]
