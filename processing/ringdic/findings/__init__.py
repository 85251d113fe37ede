"""Findings of a run about its own images and cameras, their codes, and the verdict that follows from them."""

from ringdic.findings.codes import CODES, DO_NOT_USE_EXIT, Verdict
from ringdic.findings.finding import Finding, overall_verdict, verdict_figures, verdict_headline

__all__ = ["CODES", "DO_NOT_USE_EXIT", "Finding", "Verdict", "overall_verdict", "verdict_figures", "verdict_headline"]
