"""Findings and posteriors as html; nothing here samples or simulates."""

from det2stoc_bayes.report.diagnosis_page import diagnosis_page

__all__ = ["diagnosis_page"]
