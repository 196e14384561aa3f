"""The keys of gs_sdk's sensor files, as those of :class:`torchvts.Sensor`."""

from dataclasses import dataclass
from typing import Any

from ..core.checks import check_image_size, check_positive, from_dict

RAW_CROP = 1.0 / 7.0
"""Share of a raw frame that gs_sdk cuts off each side before it resizes the rest, also where both sizes are the same."""


@dataclass(frozen=True)
class GsSdkSensor:
    """What a sensor file of gs_sdk says."""

    ppmm: float  # mm per pixel, despite its name
    imgh: int  # of the image that is worked on
    imgw: int
    raw_imgh: int | None = None  # of the camera's frames
    raw_imgw: int | None = None
    framerate: object = None  # not needed
    device_name: object = None

    def __post_init__(self) -> None:
        if check_positive("ppmm", self.ppmm) > 1.0:
            raise ValueError(f"ppmm: expected mm per pixel in (0, 1], got {self.ppmm:g}: the name misleads; invert pixels per mm")
        check_image_size("imgh", self.imgh, "imgw", self.imgw, 8)
        if self.raw_imgh is not None or self.raw_imgw is not None:
            check_image_size("raw_imgh", self.raw_imgh, "raw_imgw", self.raw_imgw, 8)


def values_from_gs_sdk(values: dict[str, Any], source: str, name: str) -> dict[str, Any]:
    """Keys and values of a :class:`torchvts.Sensor` of this name; ``source`` is named in errors.

    Example:
        >>> values_from_gs_sdk({"ppmm": 0.0634, "imgh": 240, "imgw": 320}, "mini.yaml", "mini")["mm_per_pixel"]
        0.0634
    """
    of = from_dict(GsSdkSensor, values, source)
    raw = {} if of.raw_imgh is None else {"raw_size_px": ((of.raw_imgh, of.raw_imgw),), "raw_crop": RAW_CROP}
    return {"name": name, "height": of.imgh, "width": of.imgw, "mm_per_pixel": of.ppmm, **raw}
