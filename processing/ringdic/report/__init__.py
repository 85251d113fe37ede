"""The report of a processing run as one self-contained HTML page: what was measured, with what, and how well.

Styles and pictures are inside the page; it fetches nothing. ``document`` builds the page, ``hardware`` measures cameras
and pattern on the images, ``tables`` are the reporting tables, ``noise`` the noise floor, ``plots`` the drawings.
"""

from ringdic.report.report import write_report

__all__ = ["write_report"]
