"""Symptoms: name what is wrong with an image or its calibration in words that a lab understands."""

from .diagnosis import diagnose
from .findings import SEVERITIES, Diagnosis, Finding

__all__ = ["SEVERITIES", "Diagnosis", "Finding", "diagnose"]
