"""Depth of whole data sets: folders and videos of any size."""

from .items import FORMATS, PICTURES_UP_TO, STATE, list_items, output_stems
from .reconstruct import CLOUD_FORMATS, reconstruct_dataset
from .worker import RunReport

__all__ = [
    "CLOUD_FORMATS",
    "FORMATS",
    "PICTURES_UP_TO",
    "STATE",
    "RunReport",
    "list_items",
    "output_stems",
    "reconstruct_dataset",
]
