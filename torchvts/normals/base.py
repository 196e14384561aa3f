"""What a model of normals declares, and the adapter that makes a model of any ``nn.Module``."""

from torch import Tensor, nn

from ..core.checks import check_record


class NormalModel(nn.Module):
    """Base of modules that map compensated images to normals. A subclass declares what it can do and overrides ``forward``.

    Attributes:
        uses_depth: ``forward`` makes use of a depth; needed for the modes "precise" and "auto" to go again.
        normals_from_depth: modes "precise" and "auto" return the gradient of the depth: integration keeps only what is the slope of
            a surface, so it has less noise and smaller errors than the slopes of single pixels.
        max_passes: passes after which nothing more is gained.
        takes_window: ``forward`` can work on a window of the calibrated image; else it always gets the whole image.
    Example:
        >>> import torch
        >>> class Flat(NormalModel):
        ...     takes_window = True
        ...     def forward(self, image, depth_mm=None, window=None):
        ...         return torch.cat((0.0 * image[:, :2], 1.0 + 0.0 * image[:, 2:]), dim=1)
        >>> Flat()(torch.rand(1, 3, 4, 4))[0, :, 0, 0]
        tensor([0., 0., 1.])
    """

    uses_depth: bool = False
    normals_from_depth: bool = False
    max_passes: int = 1000
    takes_window: bool = False

    def forward(self, image: Tensor, depth_mm: Tensor | None = None, window: tuple[int, int] | None = None) -> Tensor:
        """Normals of a compensated image.

        Args:
            image: (B, 3, h, w), compensated.
            depth_mm: (B, 1, h, w), the depth so far, mm; None in the first pass.
            window: (top, left), the place of the first pixel in the calibrated image; None for the whole image.
        Returns:
            (B, 3, h, w), facing the camera; of unit length where a second pass is to use it.
        """
        raise TypeError(f"{type(self).__name__}: a NormalModel must define forward(image, depth_mm, window)")

    def coarse(self, stride: int) -> "NormalModel | None":
        """The same model for an image of every ``stride``-th pixel, for the prediction of mode "auto"; None if there is none."""
        return None


class WrappedNormals(NormalModel):
    """Any module that maps compensated images (B, 3, H, W) to normals (B, 3, H, W), as a :class:`NormalModel` without depth."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, image: Tensor, depth_mm: Tensor | None = None, window: tuple[int, int] | None = None) -> Tensor:
        normal: Tensor = self.module(image)
        return normal


def as_normal_model(module: nn.Module) -> NormalModel:
    """The module itself if it is a :class:`NormalModel`, else the module in a :class:`WrappedNormals`.

    Raises:
        TypeError: no ``nn.Module``.
    """
    check_record("normals", module, nn.Module)
    return module if isinstance(module, NormalModel) else WrappedNormals(module)
