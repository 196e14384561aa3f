"""What determines a module's output beside its tensors, so that a state cannot go into a module with other settings."""

import json
import math

import torch
from torch import Tensor, nn

from .checks import brief

_KINDS = (bool, int, float, str)


def settings(module: nn.Module) -> dict[str, object]:
    """Numbers, texts and sequences of them that a tree of modules holds as plain attributes, by name such as "compensate.gamma".

    Example:
        >>> from torchvts import PoissonDCT
        >>> settings(PoissonDCT(0.1))["mm_per_pixel"]
        0.1
    """
    found: dict[str, object] = {}
    for place, part in module.named_modules():
        for name, value in vars(part).items():
            items = value if isinstance(value, tuple | list) else (value,)
            plain = all(isinstance(item, _KINDS) for item in items)
            if plain and not name.startswith("_") and name != "training":
                found[f"{place}.{name}" if place else name] = list(value) if isinstance(value, tuple) else value
    return found


def settings_as_tensor(module: nn.Module) -> Tensor:
    """:func:`settings` as bytes (uint8), which every format for states can hold."""
    text = json.dumps(settings(module), sort_keys=True)
    return torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8).clone()


def check_settings(module: nn.Module, state: Tensor) -> None:
    """Raise unless the settings of a state, by :func:`settings_as_tensor`, are those of the module.

    Raises:
        ValueError: names the settings that differ.
    """
    given = json.loads(bytes(state.detach().cpu().tolist()).decode())
    here = json.loads(json.dumps(settings(module)))
    differ = [name for name in sorted(given.keys() | here.keys()) if not _alike(given.get(name), here.get(name))]
    if differ:
        shown = ", ".join(f"{name} {brief(given.get(name))} (here {brief(here.get(name))})" for name in differ[:5])
        more = f" and {len(differ) - 5} more" if len(differ) > 5 else ""
        raise ValueError(
            f"state: expected one of a pipeline with the same settings, got {shown}{more}: of another unit or mode? "
            "make the pipeline by DepthPipeline.from_calibration from that unit's calibration first"
        )


def _alike(one: object, other: object) -> bool:
    """Equal; numbers up to what another machine rounds otherwise."""
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-5)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    return one == other
