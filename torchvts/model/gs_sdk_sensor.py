"""The keys of gs_sdk's sensor files, as those of :class:`torchvts.Sensor`."""

from typing import Any

from ..core.checks import brief, check_image_size, check_positive

SENSOR_KEYS = ("ppmm", "imgh", "imgw")
SENSOR_KEYS_OPTIONAL = ("raw_imgh", "raw_imgw", "framerate", "device_name")
"""Size of the camera's frames, which is used, and what describes the camera, which is not needed."""

RAW_CROP = 1.0 / 7.0
"""Share of a raw frame that gs_sdk cuts off each side before it resizes the rest."""


def is_gs_sdk_sensor(values: object) -> bool:
    """Whether the content of a YAML file is that of a gs_sdk sensor."""
    return isinstance(values, dict) and "ppmm" in values


def values_from_gs_sdk(values: dict[Any, Any], source: str, name: str) -> dict[str, Any]:
    """Keys and values of a :class:`torchvts.Sensor`.

    Args:
        values: of gs_sdk's file: ``ppmm``, mm per pixel despite its name; ``imgh``, ``imgw``, the size of the image worked on;
            ``raw_imgh``, ``raw_imgw``, the size of the camera's frames, of which a seventh is cut off each side, also
            where both sizes are the same.
        source: named in errors.
        name: of the sensor.
    Raises:
        ValueError: an unknown or a missing key, or a bad value.
    Example:
        >>> values_from_gs_sdk({"ppmm": 0.0634, "imgh": 240, "imgw": 320}, "mini.yaml", "mini")["mm_per_pixel"]
        0.0634
    """
    for key in values:
        if key not in SENSOR_KEYS + SENSOR_KEYS_OPTIONAL:
            raise ValueError(f"{source}: key {brief(key)}: unknown; expected {', '.join(SENSOR_KEYS + SENSOR_KEYS_OPTIONAL)}")
    for key in SENSOR_KEYS:
        if key not in values:
            raise ValueError(f"{source}: key {brief(key)}: missing; a gs_sdk sensor file has {', '.join(SENSOR_KEYS)}")
    if ("raw_imgh" in values) != ("raw_imgw" in values):
        raise ValueError(f"{source}: key 'raw_imgh', 'raw_imgw': expected both or none")
    try:
        pitch = check_positive("ppmm", values["ppmm"])
        if pitch > 1.0:
            raise ValueError(f"ppmm: expected mm per pixel in (0, 1], got {pitch:g}: the name misleads; invert pixels per mm")
        size = check_image_size("imgh", values["imgh"], "imgw", values["imgw"], 8)
        found: dict[str, Any] = {"name": name, "height": size[0], "width": size[1], "mm_per_pixel": pitch}
        if "raw_imgh" in values:
            raw = check_image_size("raw_imgh", values["raw_imgh"], "raw_imgw", values["raw_imgw"], 8)
            found |= {"raw_size_px": (raw,), "raw_crop": RAW_CROP}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source}: key {error}") from error
    return found
