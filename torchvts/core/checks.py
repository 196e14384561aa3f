"""Argument checks whose messages name the argument, what was expected, what came, and the usual cause.

Checks of shape and dtype are TorchScript and may stand in a ``forward``. Checks that read values are for constructors,
calibration and the door of the pipeline: on a GPU they would wait for the device.
"""

import dataclasses
import math
import numbers
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

_Record = TypeVar("_Record")

QUANTISATION_STD = 1.0 / 255.0 / math.sqrt(12.0)
"""Noise of rounding to 8 bits, the least that a camera image has."""


def check_batch(name: str, tensor: Tensor, channels: int) -> None:
    """Raise unless ``tensor`` is a floating-point (B, ``channels``, H, W) batch. Scripts.

    Example:
        >>> check_batch("gradient", torch.zeros(2, 8, 8), 2)
        Traceback (most recent call last):
        ...
        ValueError: gradient: expected (B, 2, H, W), got [2, 8, 8]: add the batch dimension with [None]
    """
    if tensor.dim() != 4:
        cause = "add the batch dimension with [None]" if tensor.dim() == 3 else "see the docstring for shapes"
        raise ValueError(f"{name}: expected (B, {channels}, H, W), got {list(tensor.shape)}: {cause}")
    if tensor.shape[1] != channels:
        cause = "see the docstring for shapes"
        if tensor.shape[3] == channels:
            cause = "channels stand last: permute(0, 3, 1, 2)"
        raise ValueError(f"{name}: expected (B, {channels}, H, W), got {list(tensor.shape)}: {cause}")
    if not tensor.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point tensor, got {tensor.dtype}: images are value / 255 in [0, 1]")


def check_same_size(name: str, tensor: Tensor, other_name: str, height: int, width: int) -> None:
    """Raise unless the last two dimensions of ``tensor`` are (height, width). Scripts."""
    if tensor.shape[-2] != height or tensor.shape[-1] != width:
        raise ValueError(
            f"{name}: expected {height} x {width} like {other_name}, got {tensor.shape[-2]} x {tensor.shape[-1]}: "
            "both must come from the same sensor size"
        )


def may_read_values() -> bool:
    """Whether Python may decide by the values of tensors: always, but while torch.export traces. Scripts."""
    if torch.jit.is_scripting():
        return True
    else:  # noqa: RET505, TorchScript leaves out the other branch only so
        return not torch.compiler.is_exporting()


def check_window(name: str, tensor: Tensor, size: tuple[int, int], window: tuple[int, int] | None) -> tuple[int, int]:
    """(top, left) of the part of an image of ``size`` that ``tensor`` is; without a window it must be all of it. Scripts."""
    if window is None:
        check_same_size(name, tensor, "the calibration", size[0], size[1])
        return 0, 0
    top, left = window
    rows, columns = tensor.shape[-2], tensor.shape[-1]
    if top < 0 or left < 0 or top + rows > size[0] or left + columns > size[1]:
        raise ValueError(
            f"{name}, window: expected a part of {size[0]} x {size[1]}, got {rows} x {columns} at row {top}, column {left}"
        )
    return top, left


def check_image(name: str, image: Tensor, height: int, width: int, sensor_name: str) -> None:
    """Raise unless ``image`` is one finite (3, ``height``, ``width``) image in [0, 1]."""
    if not isinstance(image, Tensor):
        raise TypeError(f"{name}: expected a torch.Tensor, got {type(image).__name__}: read files with torchvts.read_image")
    if tuple(image.shape) != (3, height, width):
        shape = tuple(image.shape)
        if len(shape) == 4 and shape[0] == 1:
            cause = "take one image of the batch with [0]"
        elif len(shape) == 3 and shape[2] == 3:
            cause = "channels stand last: permute(2, 0, 1)"
        elif len(shape) == 3 and shape[0] == 3:
            cause = f"resize it, or load the sensor with height={shape[1]}, width={shape[2]}"
        else:
            cause = "one RGB image is needed"
        raise ValueError(f"{name}: expected (3, {height}, {width}) for sensor '{sensor_name}', got {shape}: {cause}")
    if not image.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point image, got {image.dtype}: divide by 255")
    check_range(name, image)


def check_range(name: str, image: Tensor) -> None:
    """Raise unless every value is finite and in [0, 1]. Reads values."""
    low, high = (float(v) for v in torch.aminmax(image.detach()))
    if not (math.isfinite(low) and math.isfinite(high)):
        count = int((~torch.isfinite(image)).sum())
        raise ValueError(f"{name}: expected finite values, got {count} NaN or infinite: a camera or an upstream division failed")
    if high > 1.0 + 1e-3 or low < -1e-3:
        cause = "0-255 given for 0-1: divide by 255" if high > 1.5 else "clamp it to [0, 1]"
        raise ValueError(f"{name}: expected values in [0, 1], got [{low:.4g}, {high:.4g}]: {cause}")


def check_positive(name: str, value: object, most: float = math.inf) -> float:
    """Return ``value`` as a float, or raise unless it is a finite number in (0, ``most``]."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}")
    number = float(value)
    if not math.isfinite(number) or number <= 0 or number > most:
        bound = f"in (0, {most:g}]" if math.isfinite(most) else "above 0 and finite"
        raise ValueError(f"{name}: expected a number {bound}, got {value}")
    return number


def check_integer(name: str, value: object, least: int) -> int:
    """Return ``value`` as an int, or raise unless it is an integer of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name}: expected an integer, got {type(value).__name__} {value!r}")
    if int(value) < least:
        raise ValueError(f"{name}: expected at least {least}, got {value}")
    return int(value)


def check_numbers(name: str, value: object, shape: Sequence[int]) -> tuple[float, ...]:
    """Return a nested sequence of finite numbers of ``shape``, flattened, or raise."""
    text = " x ".join(str(n) for n in shape)
    try:
        tensor = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name}: expected {text} numbers, got {value!r}") from error
    if tuple(tensor.shape) != tuple(shape):
        raise ValueError(f"{name}: expected {text} numbers, got shape {tuple(tensor.shape)}")
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{name}: expected finite numbers, got {value!r}")
    return tuple(tensor.flatten().tolist())


def from_dict(cls: type[_Record], values: object, source: str) -> _Record:
    """Make a dataclass of keys and values that came from a file; errors name ``source`` and the key.

    Raises:
        ValueError: not keys and values, a key that is unknown or missing, or a value that the class refuses.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected keys and values, got {type(values).__name__}")
    fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(cls)  # type: ignore[arg-type]
    known = [field.name for field in fields]
    for key in values:
        if key not in known:
            raise ValueError(f"{source}: key {key!r}: unknown; expected {', '.join(known)}")
    for field in fields:
        if field.default is dataclasses.MISSING and field.name not in values:
            raise ValueError(f"{source}: key {field.name!r}: missing")
    try:
        return cls(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source}: key {error}") from error
