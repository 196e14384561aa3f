"""A frame as gs_sdk computes it, to compare with."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchvts.compensate import Compensate
from torchvts.core.geometry import normal_from_gradient
from torchvts.integration import divergence, poisson_dct
from torchvts.model import gs_sdk
from torchvts.normals import NormalFromMLP
from torchvts.pipeline import DepthOutput


def scipy_dct(gradient: Tensor) -> "np.ndarray[Any, Any]":
    """Depth (H, W), pixels, with a free border and zero mean, of a gradient (1, 2, H, W), by SciPy's DCT of type 2.

    Without SciPy :func:`poisson_dct` gives the same up to rounding; only with SciPy is it timed.
    """
    try:
        from scipy import fft
    except ImportError:
        depth: np.ndarray[Any, Any] = poisson_dct(gradient)[0, 0].numpy()
        return depth
    right = divergence(gradient)[0, 0].numpy()
    spectrum = fft.dctn(right, type=2)
    wave = [np.cos(np.pi * np.arange(n) / n) for n in right.shape]
    value = (2.0 * wave[0][:, None] + 2.0 * wave[1][None, :] - 4.0).astype(right.dtype)
    value[0, 0] = 1.0
    spectrum[0, 0] = 0.0
    solved: np.ndarray[Any, Any] = fft.idctn(spectrum / value, type=2)
    return solved


class GsSdkPipeline:
    """A frame in the steps of gs_sdk: its network at every pixel, SciPy's DCT in double precision, a mask by colour and height.

    It follows gs_sdk's published formats (network, gradients, height map) and the steps in its documentation; it holds none of its
    code.

    Args:
        network: the network.
        background: (3, H, W) in [0, 1], image without contact.
        blur_px: blur of the images before the network, pixels; gs_sdk has none.
    """

    def __init__(self, network: NormalFromMLP, background: Tensor, blur_px: float = 0.0) -> None:
        self.network = network.eval()
        self.smooth = Compensate(blur_px=blur_px)
        self.background = gs_sdk.image_to_bgr(background).astype(np.int16)
        with torch.inference_mode():
            self.background_gradient = self.network.gradient_px(self.smooth(background[None]))

    def __call__(self, pixels: "np.ndarray[Any, Any]") -> tuple[Any, Any, Any]:
        """B, G, R uint8 (H, W, 3) to gradients (2, H, W), height map in pixels, and mask."""
        import cv2

        with torch.inference_mode():
            image = self.smooth(gs_sdk.image_from_bgr(pixels)[None])
            gradient = (self.network.gradient_px(image) - self.background_gradient)[0].double()
        height = scipy_dct(gradient[None])
        change = np.abs(pixels.astype(np.int16) - self.background).max(axis=2)
        mask = ((change > 15) & (height < -0.2)).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        return gradient.numpy(), height, mask

    def as_output(self, images: Tensor, mm_per_pixel: float) -> DepthOutput:
        """The result in the form of a pipeline, for one frame (1, 3, H, W) and the pitch; depth is zero beside the contact."""
        gradient, height, mask = self(gs_sdk.image_to_bgr(images[0]))
        depth, contact = -mm_per_pixel * torch.from_numpy(height), torch.from_numpy(mask).bool()
        level = depth[~contact].median() if not bool(contact.all()) else depth.min()
        return as_output((depth - level)[None, None], -torch.from_numpy(gradient)[None], contact[None, None])


def peer_frame(network: NormalFromMLP, background: Tensor, image: Tensor) -> Callable[[], object] | None:
    """A frame in the steps of gs_sdk to be timed, of an image (3, H, W).

    None without SciPy, which gs_sdk uses, and for more than 480 rows, where it takes most of a run.
    """
    if find_spec("scipy") is None or image.shape[1] > 480:
        return None
    return partial(GsSdkPipeline(network, background), gs_sdk.image_to_bgr(image))


def as_output(depth_mm: Tensor, gradient: Tensor, contact: Tensor) -> DepthOutput:
    """Depth (B, 1, H, W), gradient (B, 2, H, W) and contact (B, 1, H, W) in the form of a pipeline."""
    return DepthOutput(depth_mm, gradient, normal_from_gradient(gradient), contact, contact)  # gs_sdk knows one mask
