"""What an integrator declares."""

from typing import TYPE_CHECKING

from torch import Tensor, nn


class Integrator(nn.Module):
    """Base of modules that map a gradient to depth. A subclass overrides ``forward``.

    Its depth may have any smooth offset: a pipeline counts it from the undeformed skin, by :class:`~torchvts.skin.ZeroBackground`.
    """

    if TYPE_CHECKING:

        def __call__(self, gradient: Tensor) -> Tensor: ...

    def forward(self, gradient: Tensor) -> Tensor:
        """Depth in mm, (B, 1, H, W), from a gradient (B, 2, H, W), (dz/dx, dz/dy), mm per mm."""
        raise TypeError(f"{type(self).__name__}: an Integrator must define forward(gradient)")
