"""Depth of whole data sets: folders and videos of any size."""

from .reconstruct import CLOUD_FORMATS, DEPTH_FORMATS, PICTURES_UP_TO, STATE, Report, list_items, output_stems, reconstruct_dataset

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
