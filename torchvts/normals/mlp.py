"""Normals by a small network from the colour and position of a pixel to its slope."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..core.blur import MOST_BLUR_PX
from ..core.checks import (
    check_batch,
    check_choice,
    check_field,
    check_image_size,
    check_integer,
    check_least,
    check_path,
    check_range,
    check_same_size,
    check_seed,
)
from ..core.files import load_tensors, save_tensors
from ..core.geometry import MAX_SLOPE, normal_from_gradient
from .base import DOMAINS, NormalModel

MLP_KIND = "mlp"
OUTPUTS = ("angle", "gradient")


class NormalFromMLP(NormalModel):
    """Unit normals by gs_sdk's RGBXY network, from the colour and position of a pixel.

    Inputs are B, G, R in [0, 1], then x / width, y / height in [0, 1). The two outputs are angles whose tangents are gs_sdk's
    gradients d(H)/dx, d(H)/dy of H = -z / mm_per_pixel (``output="angle"``), or those gradients themselves
    (``output="gradient"``). The network's output for the flat skin is subtracted; it is computed when the flat image is
    set, so call :meth:`set_flat` again after the weights have changed.

    Make one with :meth:`load` or :func:`torchvts.training.fit_mlp`. A new one holds random weights. The images must be preprocessed
    as those on which the network was trained, which it declares in ``input_domain`` and ``blur_px``. gs_sdk's networks take raw
    images: :meth:`torchvts.DepthPipeline.from_gs_sdk` makes a pipeline of one, and a pipeline with other images refuses it. (On a
    GelSight Mini its normals behind image / background are 50 degrees off.)

    Args:
        height: rows, pixels.
        width: columns, pixels.
        flat: (3, H, W), image of the flat skin in [0, 1], R, G, B.
        hidden: widths of the hidden layers.
        output: "angle" or "gradient".
        seed: of the random weights; the global generator is not used.
        input_domain: what the images are, a key of ``torchvts.normals.DOMAINS``.
        blur_px: standard deviation of the Gaussian blur of the images on which it was trained, pixels.
    Raises:
        ValueError, TypeError: bad sizes, a flat image of another size, range or type.
    Source:
        Wang, She, Romero, Adelson, GelSight Wedge, ICRA 2021; Huang et al., NormalFlow, RA-L 2024 (gs_sdk).
    Example:
        >>> flat = torch.full((3, 8, 12), 0.5)
        >>> NormalFromMLP(8, 12, flat)(flat[None])[0, :, 0, 0].detach().round(decimals=3) + 0.0
        tensor([0., 0., 1.])
    """

    calibrated: bool = True
    flat: Tensor
    flat_gradient: Tensor

    def __init__(
        self,
        height: int,
        width: int,
        flat: Tensor,
        hidden: Sequence[int] = (32, 32, 32),
        *,
        output: str = "angle",
        seed: int = 0,
        input_domain: str = "image",
        blur_px: float = 0.0,
    ) -> None:
        super().__init__()
        check_choice("input_domain", input_domain, tuple(DOMAINS))
        self.input_domain = input_domain
        self.blur_px = check_least("blur_px", blur_px, 0.0, MOST_BLUR_PX)
        if output not in OUTPUTS:
            raise ValueError(f"output: expected one of {', '.join(OUTPUTS)}, got {output!r}")
        self.height, self.width = check_image_size("height", height, "width", width)
        self.output = output
        self.most = math.atan(MAX_SLOPE) if output == "angle" else MAX_SLOPE
        widths = [5, *(check_integer("hidden", n, 1) for n in hidden), 2]
        if len(widths) < 3:
            raise ValueError("hidden: expected one width or more, got none")
        self.check_flat(flat)
        generator = torch.Generator().manual_seed(check_seed("seed", seed))
        self.layers = nn.ModuleList()
        for fan_in, fan_out in pairwise(widths):
            layer = nn.Linear(fan_in, fan_out, device="meta", dtype=flat.dtype).to_empty(device=flat.device)
            bound = math.sqrt(6.0 / fan_in)  # He et al., ICCV 2015: keeps the scale through ReLU
            with torch.no_grad():
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()
            self.layers.append(layer)
        self.register_buffer("flat", flat.detach().clone())
        self.register_buffer("flat_gradient", torch.zeros_like(flat[0:2]))
        self.set_flat(flat)

    def forward(self, compensated: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        """(B, 3, H, W) images, R, G, B, to (B, 3, H, W) unit normals that face the camera."""
        check_batch("compensated", compensated, 3)
        check_same_size("compensated", compensated, "the calibration", self.height, self.width)
        # H = -z / mm_per_pixel
        return normal_from_gradient(self.flat_gradient - self.gradient_px(compensated))

    def gradient_px(self, image: Tensor) -> Tensor:
        """The network's output, (B, 2, H, W): gs_sdk's d(H)/dx, d(H)/dy, before that of the flat skin is subtracted."""
        check_batch("image", image, 3)
        check_same_size("image", image, "the calibration", self.height, self.width)
        if image.dtype != self.flat.dtype:
            raise TypeError(f"image: expected {self.flat.dtype} like the network, got {image.dtype}: convert one of them")
        x = torch.arange(self.width, dtype=image.dtype, device=image.device) / self.width
        y = torch.arange(self.height, dtype=image.dtype, device=image.device) / self.height
        shape = (image.shape[0], 1, self.height, self.width)
        place = x[None, None, None, :].expand(shape), y[None, None, :, None].expand(shape)
        feature = torch.cat((image.flip(1), place[0], place[1]), dim=1)  # B, G, R, x, y
        value = feature.permute(0, 2, 3, 1).reshape(-1, 5)
        last = len(self.layers) - 1
        for k, layer in enumerate(self.layers):
            value = layer(value)
            if k < last:
                value = torch.relu(value)
        value = value.reshape(image.shape[0], self.height, self.width, 2).permute(0, 3, 1, 2)
        value = value.clamp(-self.most, self.most)
        return torch.tan(value) if self.output == "angle" else value

    def set_flat(self, flat: Tensor) -> None:
        """Set the image of the flat skin, (3, H, W) in [0, 1], or the same one again after the weights have changed.

        Raises:
            ValueError: another size, range or not finite.
            TypeError: not floating point.
        """
        self.check_flat(flat)
        with torch.no_grad():
            image = flat.detach().to(self.flat)
            self.flat = image.clone()
            self.flat_gradient = self.gradient_px(image[None])[0].clone()

    def check_flat(self, flat: Tensor) -> None:
        """Raise unless ``flat`` is one finite (3, height, width) image in [0, 1]."""
        check_field("flat", flat)
        check_same_size("flat", flat, "the images", self.height, self.width)
        check_range("flat", flat)

    @classmethod
    def load(cls, path: str | Path, flat: Tensor | None = None, *, output: str | None = None) -> "NormalFromMLP":
        """Read a network: gs_sdk's ``nnmodel.pth``, a state dict of the same layout, or what :meth:`save` wrote.

        A state dict holds ``fc1.weight``, ``fc1.bias``, ``fc2.weight`` ... of layers that follow one another, the first of 5
        inputs, the last of 2 outputs, ReLU between. Widths are free.

        Args:
            path: the file. Nothing but tensors is unpickled.
            flat: (3, H, W), image of the flat skin in [0, 1], R, G, B. It gives size and dtype. Needed for a state dict; for a
                file of torchvts, None takes the one stored.
            output: "angle" or "gradient"; None takes the file's own, or "angle".
        Returns:
            The network in eval mode, its weights frozen (``requires_grad_(True)`` frees them).
        Raises:
            FileNotFoundError: no such file.
            ValueError: cut short or no file of weights, wrong names or shapes, not finite, no flat image or one of a wrong shape
                or range.
            TypeError: flat is not floating point.
        """
        path = check_path("path", path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        described: dict[str, Any] = {}
        if path.suffix == ".safetensors":
            state: object
            state, described = load_tensors(path)
            if described.get("kind") != MLP_KIND or "flat" not in state or described.get("output") not in OUTPUTS:
                raise ValueError(f"{path}: expected a network that NormalFromMLP.save wrote, got {described.get('kind')!r}")
            stored = state.pop("flat")
            flat = stored if flat is None else flat
        else:
            state = _read_state(path)
        if flat is None:
            raise ValueError(
                "flat: expected the image of the flat skin, (3, H, W), got None: a bare state dict holds none; "
                "DepthPipeline.from_gs_sdk takes the background"
            )
        check_field("flat", flat)
        weights = _check_state(path, state)
        options: dict[str, Any] = {name: described[name] for name in ("output", "input_domain", "blur_px") if name in described}
        options |= {} if output is None else {"output": output}
        block = cls(flat.shape[1], flat.shape[2], flat, [weight.shape[0] for weight, _ in weights[:-1]], **options)
        block._set_weights(weights)
        return block.requires_grad_(False).eval()

    def save(self, path: str | Path) -> None:
        """Write weights and flat image as one safetensors file, whole or not at all.

        Raises:
            ValueError: the name does not end in .safetensors.
            FileNotFoundError: the folder is missing.
        """
        if Path(path).suffix != ".safetensors":
            raise ValueError(f"{path}: expected a name ending in .safetensors, got {Path(path).suffix!r}")
        described = {"kind": MLP_KIND, "output": self.output, "input_domain": self.input_domain, "blur_px": self.blur_px}
        save_tensors(path, {**self.gs_sdk_state(), "flat": self.flat}, described)

    def gs_sdk_state(self) -> dict[str, Tensor]:
        """The weights under gs_sdk's names, ``fc1.weight`` and so on; ``torch.save`` of it is a file that gs_sdk reads."""
        pairs = [(f"fc{k}.{name}", tensor) for k, layer in enumerate(self.layers, 1) for name, tensor in layer.named_parameters()]
        return {name: tensor.detach().clone() for name, tensor in pairs}

    def _set_weights(self, weights: list[tuple[Tensor, Tensor]]) -> None:
        with torch.no_grad():
            for layer, (weight, bias) in zip(self.layers, weights, strict=True):
                layer.get_parameter("weight").copy_(weight)
                layer.get_parameter("bias").copy_(bias)
        self.set_flat(self.flat)

    def extra_repr(self) -> str:
        return f"height={self.height}, width={self.width}, output={self.output}"


def _read_state(path: Path) -> object:
    try:
        state: object = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file may fail anywhere in torch's reader
        reason = str(error).strip().splitlines()[0].split(". ")[0] if " " in str(error).strip() else type(error).__name__
        raise ValueError(
            f"{path}: expected a state dict of torch.save, got what torch cannot read: another kind of file, cut short, or one "
            f"that holds more than tensors, which is refused ({reason})"
        ) from error
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        raise ValueError(
            f"{path}: expected a bare state dict, got one under 'state_dict', like gsrobotics' nnmini.pt: such a network gives n_x "
            "and n_y of the normal, from constant places, and is not read: use the sensor's prior, or torchvts train. "
            "If yours gives angles or gradients, save what is under 'state_dict' by torch.save"
        )
    return state


def _check_state(path: Path, state: object) -> list[tuple[Tensor, Tensor]]:
    """Return weight and bias of fc1, fc2, ..., or raise."""
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"{path}: expected a state dict of tensors fc1.weight, fc1.bias, ..., got {type(state).__name__}")
    count = len(state) // 2
    expected = [f"fc{k}.{kind}" for k in range(1, count + 1) for kind in ("weight", "bias")]
    if count < 2 or {str(key) for key in state} != set(expected):
        names = ", ".join(sorted(str(key) for key in state)[:8])
        raise ValueError(f"{path}: expected the tensors fc1.weight, fc1.bias, fc2.weight, ..., got {names}: another network?")
    weights: list[tuple[Tensor, Tensor]] = []
    inputs = 5
    for k in range(1, count + 1):
        weight, bias = state[f"fc{k}.weight"], state[f"fc{k}.bias"]
        outputs = 2 if k == count else (weight.shape[0] if weight.dim() == 2 else 0)
        if outputs == 0 or tuple(weight.shape) != (outputs, inputs) or tuple(bias.shape) != (outputs,):
            wanted = f"({outputs or 'n'}, {inputs})"
            raise ValueError(
                f"{path}: fc{k}: expected weight {wanted} and a bias to match, got {tuple(weight.shape)} and {tuple(bias.shape)}: "
                "the network takes B, G, R, x, y and gives two slopes"
            )
        if not weight.is_floating_point() or not bias.is_floating_point():
            raise ValueError(f"{path}: fc{k}: expected floating point, got {weight.dtype} and {bias.dtype}: a quantised network?")
        if not bool(torch.isfinite(weight).all() and torch.isfinite(bias).all()):
            raise ValueError(f"{path}: fc{k}: expected finite weights, got NaN or infinite: its training diverged")
        weights.append((weight, bias))
        inputs = outputs
    return weights
