"""What an integrator declares, and the adapter that makes an integrator of any ``nn.Module``."""

from typing import TYPE_CHECKING

from torch import Tensor, nn

from ..core.checks import check_batch, check_record, check_window


class Integrator(nn.Module):
    """Base of modules that map a gradient to depth. A subclass overrides ``forward``.

    It decides where depth is zero: the pipeline changes only the depth of :class:`~torchvts.integration.PoissonBackground`.
    """

    if TYPE_CHECKING:

        def __call__(
            self, gradient: Tensor, window: tuple[int, int] | None = None, size: tuple[int, int] | None = None
        ) -> Tensor: ...

    def forward(self, gradient: Tensor, window: tuple[int, int] | None = None, size: tuple[int, int] | None = None) -> Tensor:
        """Depth of the whole image from the gradient of a window, which is zero elsewhere.

        Args:
            gradient: (B, 2, h, w), (dz/dx, dz/dy), mm per mm.
            window: (top, left), the place of the first pixel in the whole image; None for the whole image.
            size: (H, W) of the whole image; None for that of the gradient.
        Returns:
            Depth in mm, (B, 1, H, W).
        """
        raise TypeError(f"{type(self).__name__}: an Integrator must define forward(gradient, window, size)")


class WrappedIntegrator(Integrator):
    """Any module that maps gradients (B, 2, H, W) to depth (B, 1, H, W), as an :class:`Integrator`: it gets the whole gradient."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, gradient: Tensor, window: tuple[int, int] | None = None, size: tuple[int, int] | None = None) -> Tensor:
        depth: Tensor = self.module(embedded(gradient, window, size))
        return depth


def as_integrator(module: nn.Module) -> Integrator:
    """The module itself if it is an :class:`Integrator`, else the module in a :class:`WrappedIntegrator`.

    Raises:
        TypeError: no ``nn.Module``.
    """
    check_record("integrate", module, nn.Module)
    return module if isinstance(module, Integrator) else WrappedIntegrator(module)


def embedded(gradient: Tensor, window: tuple[int, int] | None, size: tuple[int, int] | None) -> Tensor:
    """The gradient of a window embedded in the whole image (B, 2, H, W), zero elsewhere."""
    if size is None:
        return gradient
    check_batch("gradient", gradient, 2)
    rows, columns = gradient.shape[2], gradient.shape[3]
    top, left = check_window("gradient", gradient, size, window)
    if rows == size[0] and columns == size[1]:
        return gradient
    return nn.functional.pad(gradient, [left, size[1] - left - columns, top, size[0] - top - rows])
