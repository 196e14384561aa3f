"""Depth of whole data sets: folders and videos of any size."""

from .items import PICTURES_UP_TO, STATE, list_items, output_stems
from .reconstruct import CLOUD_FORMATS, DEPTH_FORMATS, Report, reconstruct_dataset

__all__ = [
    "CLOUD_FORMATS",
    "DEPTH_FORMATS",
    "PICTURES_UP_TO",
    "STATE",
    "Report",
    "list_items",
    "output_stems",
    "reconstruct_dataset",
]
