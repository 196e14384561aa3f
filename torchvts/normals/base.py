"""What a model of normals declares, and the adapter that makes a model of any ``nn.Module``."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.checks import brief, check_record

DOMAINS = {
    "image": "images as the camera gives them, value / 255",
    "ratio": "image / background, 1 without contact, as a calibration by response fields gives",
    "light": "linear light scaled to that of the light model, as a calibration by lights gives",
}
"""What a model of normals may work on, in words."""

CODED = 100.0
"""Length beyond which vectors are no normals, not even of a network that is not trained: colours go to 255."""

FROM_GS_SDK = """
    import torchvts as vts
    sensor = vts.Sensor.load("gelsight_mini")
    background = vts.read_image("background.png")
    pipe = vts.DepthPipeline.from_gs_sdk("nnmodel.pth", background, sensor)
    out = pipe(vts.read_image("press.png")[None])"""
"""How a network that was trained on camera images becomes a pipeline."""


class NormalModel(nn.Module):
    """Base of modules that map compensated images to normals. A subclass declares what it can do and overrides ``forward``.

    Attributes:
        uses_depth: ``forward`` makes use of a depth; needed for the mode "precise" to go again.
        normals_from_depth: all modes return the gradient of the depth: integration keeps only what is the slope of
            a surface, so it has less noise and smaller errors than the slopes of single pixels.
        passes: how often mode "precise" solves a frame.
        calibrated: True: its slopes, beside the colour, decide where the skin has moved, and its normals are not checked. False,
            as of a network that may be in training: colour alone decides, and its normals are checked.
        input_domain: what ``forward`` works on, a key of :data:`DOMAINS`; a pipeline whose compensated images are something else
            is refused. None: it gets what the pipeline gives.
    Example:
        >>> import torch
        >>> class Flat(NormalModel):
        ...     def forward(self, image, depth_mm=None):
        ...         return torch.cat((0.0 * image[:, :2], 1.0 + 0.0 * image[:, 2:]), dim=1)
        >>> Flat()(torch.rand(1, 3, 4, 4))[0, :, 0, 0]
        tensor([0., 0., 1.])
    """

    uses_depth: bool = False
    normals_from_depth: bool = False
    passes: int = 3
    calibrated: bool = False
    input_domain: str | None = None

    if TYPE_CHECKING:

        def __call__(self, image: Tensor, depth_mm: Tensor | None = None) -> Tensor: ...

    def forward(self, image: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        """Normals of a compensated image.

        Args:
            image: (B, 3, H, W), compensated.
            depth_mm: (B, 1, H, W), the depth so far, mm; None in the first pass.
        Returns:
            (B, 3, H, W), facing the camera; of unit length where a second pass is to use it.
        """
        raise TypeError(f"{type(self).__name__}: a NormalModel must define forward(image, depth_mm)")


def declared_domain(module: nn.Module) -> str | None:
    """``input_domain`` of a module, or of what it wraps: a compiled or parallel one, or the first of a sequence; None for none."""
    found: object = getattr(module, "input_domain", None)
    if found is None:
        inner = next(module.children(), None) if isinstance(module, nn.Sequential) else None
        for name in ("_orig_mod", "module"):
            inner = getattr(module, name, inner)
        return declared_domain(inner) if isinstance(inner, nn.Module) else None
    if found not in DOMAINS:
        raise ValueError(f"input_domain: expected one of {', '.join(DOMAINS)}, or None, got {found!r}")
    return str(found)


class WrappedNormals(NormalModel):
    """Any module that maps compensated images (B, 3, H, W) to normals (B, 3, H, W), as a :class:`NormalModel` without depth."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module
        self.input_domain = declared_domain(module)

    def forward(self, image: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        normal: Tensor = self.module(image)
        return normal


def as_normal_model(module: nn.Module) -> NormalModel:
    """The module itself if it is a :class:`NormalModel`, else the module in a :class:`WrappedNormals`.

    Raises:
        TypeError: no ``nn.Module``.
    """
    check_record("normals", module, nn.Module)
    return module if isinstance(module, NormalModel) else WrappedNormals(module)


def check_normals(model: nn.Module, normal: object, image: Tensor) -> str:
    """Raise unless what a module gives can be the normals of an image. Reads values.

    Args:
        model: the module, named in errors.
        normal: what it gave.
        image: (B, 3, H, W), what it was given.
    Returns:
        The module's name.
    Raises:
        TypeError: no tensor, or of another dtype; fewer bits are taken where autocast chose them.
        ValueError: of another shape, values that are not finite, or normals coded as colours.
    """
    name = type(model.module if isinstance(model, WrappedNormals) else model).__name__
    if not isinstance(normal, Tensor):
        raise TypeError(f"normals: expected a tensor from {name}, got {brief(normal)}: return the normals alone")
    wanted = tuple(image.shape)
    if tuple(normal.shape) != wanted:
        raise ValueError(
            f"normals: expected {wanted} from {name}, the shape of its input, got {tuple(normal.shape)}: "
            "three components in dimension 1, one normal for each pixel"
        )
    lowered = torch.is_autocast_enabled(image.device.type) and normal.dtype in (torch.float16, torch.bfloat16)
    if normal.dtype != image.dtype and not lowered:
        raise TypeError(f"normals: expected {image.dtype} from {name}, the type of its input, got {normal.dtype}: cast it back")
    if normal.numel() == 0:
        return name
    values = normal.detach()
    low, high = (float(value) for value in values.aminmax())
    if not (math.isfinite(low) and math.isfinite(high)):
        count = int((~values.isfinite()).sum())
        raise ValueError(
            f"normals: expected finite values from {name}, got {count} of {values.numel()} NaN or infinite: "
            "a division by zero, or weights that diverged in training"
        )
    # a flat place is coded as (0.5, 0.5, 1); a network that is not trained yet may give any constant
    coded = low >= 0.0 and 0.95 < high <= 1.0 and bool((values[:, :2].flatten(2).mean(dim=2) - 0.5).abs().max() < 0.1)
    if coded or max(-low, high) > CODED:
        raise ValueError(
            f"normals: expected unit vectors from {name}, in [-1, 1] and zero in x and y on undeformed skin, got [{low:.4g}, "
            f"{high:.4g}]: coded as colours? take 2 * value - 1, of values in [0, 1]"
        )
    return name


def check_domain(model: NormalModel, given: str | None) -> None:
    """Raise unless a model works on what the compensation before it gives; where one of them declares nothing, all is accepted.

    A camera's image is accepted for light: with a linear camera and without a background it is the same.

    Args:
        model: the model of normals.
        given: key of :data:`DOMAINS`, what the compensated images are.
    Raises:
        ValueError: another domain; names both, and what to do.
    """
    wanted = model.input_domain
    if wanted is None or given is None or wanted == given or (wanted, given) == ("light", "image"):
        return
    name = type(model.module if isinstance(model, WrappedNormals) else model).__name__
    cure = {
        "image": (
            "a network of your own takes its place in DepthPipeline(Compensate(), ContactMask(background), network, "
            "GradientFromNormal(), PoissonDCT(pitch), mm_per_pixel=pitch), one of gs_sdk's in the pipeline of such "
            f"networks:{FROM_GS_SDK}"
        ),
        "ratio": "put it behind Compensate.from_calibration of a unit that is calibrated by response fields",
        "light": "put it behind Compensate.from_calibration of a unit that is calibrated by lights",
    }[wanted]
    raise ValueError(f"normals: {name} works on {DOMAINS[wanted]}; its input here is {DOMAINS[given]}: {cure}")
