"""What an integrator declares, and the adapter that makes an integrator of any ``nn.Module``."""

from typing import TYPE_CHECKING

from torch import Tensor, nn

from ..core.checks import check_pitch, check_record


class Integrator(nn.Module):
    """Base of modules that map a gradient to depth. A subclass overrides ``forward``.

    Its depth may have any smooth offset: a pipeline counts it from the undeformed skin, by :class:`~torchvts.skin.ZeroBackground`.
    """

    if TYPE_CHECKING:

        def __call__(self, gradient: Tensor) -> Tensor: ...

    def forward(self, gradient: Tensor) -> Tensor:
        """Depth in mm, (B, 1, H, W), from a gradient (B, 2, H, W), (dz/dx, dz/dy), mm per mm."""
        raise TypeError(f"{type(self).__name__}: an Integrator must define forward(gradient)")


class WrappedIntegrator(Integrator):
    """Any module that maps gradients (B, 2, H, W) to depth (B, 1, H, W), as an :class:`Integrator`."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, gradient: Tensor) -> Tensor:
        depth: Tensor = self.module(gradient)
        return depth


def as_integrator(module: nn.Module, mm_per_pixel: float | None = None) -> Integrator:
    """The module itself if it is an :class:`Integrator`, else the module in a :class:`WrappedIntegrator`.

    Args:
        module: any that maps gradients to depth.
        mm_per_pixel: pitch that it must have, if it says one: by another its depth would be wrong. None for any.
    Raises:
        TypeError: no ``nn.Module``. ValueError: another pitch.
    """
    check_record("integrate", module, nn.Module)
    if mm_per_pixel is not None:
        check_pitch("integrate", module, mm_per_pixel)
    return module if isinstance(module, Integrator) else WrappedIntegrator(module)
