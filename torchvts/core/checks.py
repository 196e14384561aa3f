"""Argument checks whose messages name the argument, the expected value, the actual value, and the usual cause.

Checks of shape and dtype script and may be used in ``forward``. Checks that read values are for constructors and calibration,
because on a GPU they wait for the device.
"""

import dataclasses
import math
import numbers
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from .spelling import suggest

_Record = TypeVar("_Record")

MOST_PIXELS = 2**26
"""An image of more pixels, 8192 x 8192, is neither read nor made."""

MOST_DECAY_MM = 10.0
"""Free skin decays within less: more is a length in um."""

NAMED = 5
"""So many of what is wrong are named at once; a folder of another sensor's has thousands."""

MOST_COUNT = 2**31 - 1
"""No count of anything here is larger; larger integers are refused before they reach an operator, which overflows."""

LEAST_NUMBER, MOST_NUMBER = float(torch.finfo(torch.float32).tiny), float(torch.finfo(torch.float32).max)
"""A smaller number is zero in float32, a larger one infinite."""

OVERSHOOT = 1e-3
"""By so much values of images may lie outside of [0, 1]: resizing and filters round."""

QUANTISATION_STD = 1.0 / 255.0 / math.sqrt(12.0)
"""Standard deviation of rounding to 8 bits, the least noise of a camera image."""


def check_tensor(name: str, value: object) -> None:
    """Raise unless ``value`` is a tensor; for an array of NumPy or OpenCV the message says how to convert it."""
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_nested or value.is_quantized or value.device.type == "meta":
            kind = "quantised" if value.is_quantized else "nested" if value.is_nested else f"{value.layout} on {value.device}"
            raise TypeError(f"{name}: expected a dense tensor with values, got one that is {kind}")
        return
    cause = "torch.tensor(...) makes one"
    if isinstance(value, str | os.PathLike):
        cause = "read files with torchvts.read_image"
    elif hasattr(value, "__array_interface__"):
        cause = "torch.from_numpy(array) makes one"
        array: np.ndarray[Any, Any] = np.asarray(value)
        shape, kind = array.shape, array.dtype
        if len(shape) == 3 and shape[2] in (3, 4):
            scale = f" / {np.iinfo(kind).max}" if np.issubdtype(kind, np.integer) else ""
            cause = (
                f"torch.from_numpy(array).permute(2, 0, 1){scale} makes an image of one in R, G, B (OpenCV's are B, G, R), "
                "torchvts.read_image reads a file"
            )
    raise TypeError(f"{name}: expected a torch.Tensor, got {type(value).__name__}: {cause}")


def check_float_tensor(name: str, value: object) -> None:
    """Raise unless ``value`` is a dense tensor of float32 or float64."""
    check_tensor(name, value)
    assert isinstance(value, Tensor)
    if not value.is_floating_point():
        raise TypeError(f"{name}: expected floating point, got {value.dtype}: use .float()")
    if value.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}: too few bits for depth; use .float()")


def check_mask(name: str, value: Tensor) -> None:
    """Raise unless ``value`` is a dense tensor of bool. Scripts."""
    if not torch.jit.is_scripting():
        check_tensor(name, value)
    if value.dtype != torch.bool:
        raise TypeError(f"{name}: expected a tensor of bool, got {value.dtype}: compare it, mask > 0")


def check_dtype(name: str, value: object) -> None:
    """Raise unless ``value`` is float32 or float64."""
    if value not in (torch.float32, torch.float64) or not isinstance(value, torch.dtype):
        raise TypeError(f"{name}: expected torch.float32 or torch.float64, got {brief(value)}: too few bits for depth")


def check_switch(name: str, value: object) -> bool:
    """Return ``value``, or raise unless it is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name}: expected True or False, got {type(value).__name__}")
    return value


def check_seed(name: str, value: object) -> int:
    """Return ``value`` as an int, or raise if it is no integer from 0 to 2**63 - 1."""
    return check_integer(name, value, 0, 2**63 - 1)


def check_record(name: str, value: object, kind: type, cause: str = "") -> None:
    """Raise unless ``value`` is a ``kind``; ``cause`` says how to make one."""
    if not isinstance(value, kind):
        what = kind.__name__ if kind.__name__.endswith("Lights") else f"a {kind.__name__}"
        raise TypeError(f"{name}: expected {what}, got {type(value).__name__}{f': {cause}' if cause else ''}")


def check_path(name: str, value: object) -> Path:
    """Return ``value`` as a Path, or raise if it is not the name of a file or folder."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name}: expected a path, got {type(value).__name__}")
    if "\0" in str(value):
        raise ValueError(f"{name}: expected a path, got {str(value)!r}: file names cannot contain NUL")
    return Path(value)


def check_size(height: object, width: object, mm_per_pixel: object, least: int = 1) -> None:
    """Raise unless height and width are those of an image of at least ``least`` pixels each way, and the pitch is above 0."""
    check_image_size("height", height, "width", width, least)
    mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)


def check_image_size(height_name: str, height: object, width_name: str, width: object, least: int = 1) -> tuple[int, int]:
    """Return height and width as ints, or raise if they are no integers of at least ``least``, or no image holds so many pixels."""
    size = check_integer(height_name, height, least, MOST_PIXELS), check_integer(width_name, width, least, MOST_PIXELS)
    if size[0] * size[1] > MOST_PIXELS:
        raise ValueError(
            f"{height_name}, {width_name}: expected at most {MOST_PIXELS} pixels, got {size[0]} x {size[1]}: in pixels, not in mm"
        )
    return size


def check_sequence(name: str, value: object, items: str) -> None:
    """Raise unless ``value`` is a sequence of ``items`` (their name), or a batch of images."""
    batch = isinstance(value, Tensor) and value.dim() == 4
    if isinstance(value, str) or not (batch or isinstance(value, Sequence)):
        raise TypeError(f"{name}: expected a list of {items}, got {type(value).__name__}: write [item] for a single one")


def check_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """Return ``value``, or raise if it is none of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {brief(value)}{suggest(value, choices)}")
    return value


def check_batch(name: str, tensor: Tensor, channels: int) -> None:
    """Raise unless ``tensor`` is a floating-point (B, ``channels``, H, W) batch. Scripts."""
    if not torch.jit.is_scripting():
        check_tensor(name, tensor)
    if tensor.dim() != 4:
        cause = "add the batch dimension with [None]" if tensor.dim() == 3 else "see the docstring for shapes"
        raise ValueError(f"{name}: expected (B, {channels}, H, W), got {list(tensor.shape)}: {cause}")
    if tensor.shape[1] != channels:
        cause = "see the docstring for shapes"
        if tensor.shape[3] == channels:
            cause = "channels stand last: permute(0, 3, 1, 2)"
        elif channels == 3 and tensor.shape[1] == 1:
            cause = "grey images: slopes need the three colours of the light, read the camera in colour"
        elif channels == 3 and tensor.shape[1] == 4:
            cause = "with an alpha channel: image[:, :3] leaves it out"
        raise ValueError(f"{name}: expected (B, {channels}, H, W), got {list(tensor.shape)}: {cause}")
    if tensor.shape[2] == 0 or tensor.shape[3] == 0:
        raise ValueError(f"{name}: expected images of at least one pixel, got {list(tensor.shape)}: was the file empty?")
    if not tensor.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point tensor, got {tensor.dtype}: images are value / 255 in [0, 1]")
    if tensor.dtype != torch.float32 and tensor.dtype != torch.float64:
        raise TypeError(f"{name}: expected float32 or float64, got {tensor.dtype}: too few bits for depth; use .float()")


def check_pitch(name: str, block: object, mm_per_pixel: float) -> None:
    """Raise where a block has a pitch of its own, and not this one: by another its values would be wrong."""
    own = getattr(block, "mm_per_pixel", None)
    if isinstance(own, float) and abs(own / mm_per_pixel - 1.0) > 1e-6:
        kind = type(block).__name__
        raise ValueError(
            f"{name}: expected a pitch of {mm_per_pixel:g} mm per pixel, got {kind} with {own:g}: {kind}(mm_per_pixel=...) takes "
            "the sensor's"
        )


def check_same_size(name: str, tensor: Tensor, other_name: str, height: int, width: int) -> None:
    """Raise unless the last two dimensions of ``tensor`` are (height, width). Scripts."""
    if tensor.shape[-2] != height or tensor.shape[-1] != width:
        raise ValueError(
            f"{name}: expected {height} x {width} like {other_name}, got {tensor.shape[-2]} x {tensor.shape[-1]}: "
            "both must come from the same sensor size"
        )


def check_same_count(name: str, tensor: Tensor, other_name: str, count: int) -> None:
    """Raise unless ``tensor`` holds ``count`` frames, or one frame for all. Scripts."""
    if tensor.shape[0] != count and tensor.shape[0] != 1:
        raise ValueError(
            f"{name}: expected {count} frames like {other_name}, or one for all, got {tensor.shape[0]}: of another batch?"
        )


def may_read_values() -> bool:
    """Whether Python may branch on values of tensors: always, except while torch.export or torch.compile traces. Scripts."""
    if torch.jit.is_scripting():
        return True
    else:  # noqa: RET505, TorchScript needs the else to skip this branch
        return not torch.compiler.is_compiling()


def may_read(tensor: Tensor) -> bool:
    """Whether Python may branch on a tensor's values to save work: on a CPU, because elsewhere it waits for the device. Scripts."""
    return may_read_values() and tensor.device.type == "cpu"


def reads_freely(tensor: Tensor) -> bool:
    """Whether Python may compare the values of a tensor at once: on a CPU, in eager mode."""
    return may_read(tensor) and not torch.jit.is_tracing()  # type: ignore[no-untyped-call]


def has_memory(tensor: Tensor) -> bool:
    """Whether a tensor has memory of its own, which one of a transform of torch.func, or without values, has not."""
    if type(tensor) not in (Tensor, torch.nn.Parameter):
        return False
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False
    return True


def check_image(name: str, image: Tensor, height: int, width: int, sensor_name: str) -> None:
    """Raise unless ``image`` is one finite (3, ``height``, ``width``) image in [0, 1]."""
    check_tensor(name, image)
    if tuple(image.shape) != (3, height, width):
        shape = tuple(image.shape)
        cause = _cause_of_shape(image)
        if len(shape) == 3 and shape[0] == 3 and shape[2] != 3:
            cause = f"resize it, or load the sensor with height={shape[1]}, width={shape[2]}"
        raise ValueError(f"{name}: expected (3, {height}, {width}) for sensor '{sensor_name}', got {shape}: {cause}")
    _check_float_image(name, image)
    check_range(name, image)


def _check_float_image(name: str, image: Tensor) -> None:
    if not image.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point image, got {image.dtype}: divide by 255")
    check_float_tensor(name, image)


def _cause_of_shape(image: Tensor) -> str:
    """Why ``image`` is not (3, H, W)."""
    if image.dim() == 4:
        return "take one image of the batch with [0]"
    if image.dim() == 3 and image.shape[2] == 3:
        return "channels stand last: permute(2, 0, 1)"
    return "one RGB image is needed"


def check_field(name: str, value: object) -> None:
    """Raise unless ``value`` is one (3, H, W) image of finite floats. Reads values."""
    check_tensor(name, value)
    assert isinstance(value, Tensor)
    if value.dim() != 3 or value.shape[0] != 3 or value.numel() == 0:
        raise ValueError(f"{name}: expected (3, H, W), got {tuple(value.shape)}: {_cause_of_shape(value)}")
    _check_float_image(name, value)
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name}: expected finite values, got NaN or infinite: a camera or an upstream division failed")


def check_shape(name: str, value: object, shape: Sequence[int], like: str = "") -> None:
    """Raise unless ``value`` is a tensor of ``shape``, the shape of ``like``."""
    check_tensor(name, value)
    assert isinstance(value, Tensor)
    if tuple(value.shape) != tuple(shape):
        raise ValueError(f"{name}: expected {tuple(shape)}{f' like {like}' if like else ''}, got {tuple(value.shape)}")


def check_values(name: str, value: object, shape: Sequence[int], bound: str = "") -> None:
    """Raise unless ``value`` is a float tensor of ``shape``, finite, and "above 0" or "of at least 0" where ``bound`` says so."""
    check_float_tensor(name, value)
    check_shape(name, value, shape)
    assert isinstance(value, Tensor)
    good = torch.isfinite(value) & (value > 0 if bound == "above 0" else (value >= 0) | (bound == ""))
    if not bool(good.all()):
        raise ValueError(f"{name}: expected finite values {bound}".rstrip() + f", got {brief(value.tolist())}")


def check_range(name: str, image: Tensor) -> None:
    """Raise unless every value is finite and in [0, 1]. Reads values, which :func:`torch.func.vmap` does not let."""
    if image.numel() == 0:
        return
    try:
        low, high = (float(v) for v in torch.aminmax(image.detach()))
    except RuntimeError as error:
        if "vmap" in str(error):
            raise RuntimeError(
                f"{name}: expected a batch of frames, got a frame of torch.func.vmap: call it on the batch"
            ) from error
        raise
    if not (math.isfinite(low) and math.isfinite(high)):
        count = int((~torch.isfinite(image)).sum())
        raise ValueError(f"{name}: expected finite values, got {count} NaN or infinite: a camera or an upstream division failed")
    if not (low >= -OVERSHOOT and high <= 1.0 + OVERSHOOT):
        cause = "0-255 given for 0-1: divide by 255" if high > 1.5 else "clamp it to [0, 1]"
        if low < -0.1 and 0.3 < high < 20.0:
            cause = "normalised by mean and standard deviation, or scaled to [-1, 1], as for a network? give value / 255"
        raise ValueError(f"{name}: expected values in [0, 1], got [{low:.4g}, {high:.4g}]: {cause}")


def parse_number(text: str) -> float:
    """A finite decimal number of a text file; Python's own ``float`` also takes "1_0", "nan" and digits of other scripts."""
    word = text.strip()
    number = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(number):
        raise ValueError(f"expected a number, got {brief(text)}{': write a decimal point' if ',' in text else ''}")
    return number


_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def check_positive(name: str, value: object, most: float = math.inf) -> float:
    """Return ``value`` as a float, or raise if it is no finite number in (0, ``most``]."""
    return _check_number(name, value, LEAST_NUMBER, most, f"in (0, {most:g}]" if math.isfinite(most) else "above 0 and finite")


def check_least(name: str, value: object, least: float = 0.0, most: float = math.inf) -> float:
    """Return ``value`` as a float, or raise if it is no finite number in [``least``, ``most``]."""
    bound = f"of at least {least:g}" if math.isfinite(least) else "that is finite"
    return _check_number(name, value, least, most, f"in [{least:g}, {most:g}]" if math.isfinite(most) else bound)


def _check_number(name: str, value: object, least: float, most: float, bound: str) -> float:
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        comma = f" {brief(value)}: write a decimal point" if isinstance(value, str) and "," in value else ""
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}{comma}")
    number = _float(value)
    if not math.isfinite(number) or not least <= number <= most:
        raise ValueError(f"{name}: expected a number {bound}, got {brief(value)}")
    return number


def check_camera_height(value: object) -> float:
    """Return ``value`` as a float, or raise unless it is above 0; infinity means an orthographic camera."""
    if isinstance(value, float) and value == math.inf:
        return value
    return check_positive("camera_height_mm", value)


def check_decay(name: str, value: object) -> float:
    """Return ``value`` as the length over which free skin decays, mm, or raise."""
    return check_least(name, value, 0.0, MOST_DECAY_MM)


def _float(value: numbers.Real) -> float:
    """The number as a float; infinite or zero where float32 is, and where operators cannot take the integer."""
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        return math.inf
    if abs(number) > MOST_NUMBER or (isinstance(value, numbers.Integral) and abs(number) >= 2.0**63):
        return math.copysign(math.inf, number)
    return 0.0 if abs(number) < LEAST_NUMBER else number  # NaN stays NaN


def check_integer(name: str, value: object, least: int, most: int = MOST_COUNT) -> int:
    """Return ``value`` as an int, or raise if it is no integer from ``least`` to ``most``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name}: expected an integer, got {type(value).__name__} {brief(value)}")
    if int(value) < least:
        raise ValueError(f"{name}: expected at least {least}, got {brief(value)}")
    if int(value) > most:
        raise ValueError(f"{name}: expected at most {most}, got {brief(value)}")
    return int(value)


def brief(value: object) -> str:
    """``repr(value)`` for a message, shortened to 200 characters."""
    try:
        text = repr(value)
    except Exception:  # of an integer of more than 4,300 digits, or of an object that fails
        return f"{type(value).__name__} without a text"
    return text if len(text) <= 200 else f"{text[:160]} ... ({len(text)} characters)"


def in_one_line(error: BaseException) -> str:
    """The text of an error on one line; its kind where it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


def check_numbers(name: str, value: object, shape: Sequence[int]) -> tuple[float, ...]:
    """Return a nested sequence of finite numbers of ``shape``, flattened, or raise."""
    text = " x ".join(str(n) for n in shape)
    try:
        tensor = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"{name}: expected {text} numbers, got {brief(value)}") from error
    if tuple(tensor.shape) != tuple(shape):
        raise ValueError(f"{name}: expected {text} numbers, got shape {tuple(tensor.shape)}")
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{name}: expected finite numbers, got {brief(value)}")
    return tuple(tensor.flatten().tolist())


def from_dict(
    cls: type[_Record], values: object, source: str, parts: Mapping[str, Callable[[Any, str], Any]] | None = None
) -> _Record:
    """Make a dataclass from the keys and values of a file; errors name ``source``, the file, and the key.

    Values that are records themselves are read by ``parts``, each by its key.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected keys and values, got {type(values).__name__}")
    fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(cls)  # type: ignore[arg-type]
    known = [field.name for field in fields]
    for key in values:
        if key not in known:
            raise ValueError(f"{source}: key {brief(key)}: unknown; expected {', '.join(known)}{suggest(key, known)}")
    for field in fields:
        if field.default is dataclasses.MISSING and field.name not in values:
            raise ValueError(f"{source}: key {field.name!r}: missing")
    read = {key: part(values[key], f"{source}: {key}") for key, part in (parts or {}).items() if values.get(key) is not None}
    try:
        return cls(**{**values, **read})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source}: key {error}") from error
