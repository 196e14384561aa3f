"""Numbers that determine a module's output beside its tensors, so that a state cannot go into a module with others."""

import json
import math

import torch
from torch import Tensor, nn


def settings(module: nn.Module) -> dict[str, float]:
    """Numbers, and those in sequences, that a tree of modules holds as plain attributes, by name such as "compensate.gamma"."""
    found: dict[str, float] = {}
    for place, part in module.named_modules():
        for name, value in vars(part).items():
            for k, item in enumerate(value if isinstance(value, tuple | list) else (value,)):
                if isinstance(item, bool | int | float) and not name.startswith("_") and name != "training":
                    found[f"{place}.{name}" + f".{k}" * isinstance(value, tuple | list)] = float(item)
    return {name.removeprefix("."): value for name, value in found.items()}


def settings_as_tensor(module: nn.Module) -> Tensor:
    """:func:`settings` as bytes (uint8), which every format for states can hold."""
    return torch.frombuffer(bytearray(json.dumps(settings(module)).encode()), dtype=torch.uint8).clone()


def check_settings(module: nn.Module, state: Tensor) -> None:
    """Raise unless the settings of a state, by :func:`settings_as_tensor`, are those of the module, up to rounding."""
    given, here = json.loads(bytes(state.tolist())), settings(module)
    both = sorted(given.keys() | here.keys())
    differ = [name for name in both if not math.isclose(given.get(name, math.nan), here.get(name, math.nan), rel_tol=1e-5)]
    if differ:
        raise ValueError(
            f"state: expected one of a pipeline with the same settings, got others in {', '.join(differ[:5])}: of another unit or "
            "mode? make the pipeline by DepthPipeline.from_calibration from that unit's calibration first"
        )
