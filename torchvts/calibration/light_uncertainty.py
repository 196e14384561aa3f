"""How well a background constrains fitted lights: covariance and unexplained structure."""

from typing import NamedTuple

import torch
from torch import Tensor

from .background import BackgroundPixels


class Linearisation(NamedTuple):
    """The fitted problem around its solution.

    Attributes:
        pixels: the pixels, N of them.
        parameter: (3, K), of the lights.
        residual: (3, N), in units of the noise.
        jacobian: (3, K, N), derivative of the residual.
        weight: (3, N), robust weights over the squared scale.
    """

    pixels: BackgroundPixels
    parameter: Tensor
    residual: Tensor
    jacobian: Tensor
    weight: Tensor

    def is_finite(self) -> bool:
        return all(bool(torch.isfinite(values).all()) for values in (self.residual, self.jacobian, self.weight))


def covariance_and_misfit(fit: Linearisation) -> tuple[Tensor, Tensor]:
    r"""Covariance (3, K, K) of the parameters and misfit (3,), both including what the model does not explain.

    Vignetting, scattered light and uneven skin act as a smooth relative gain. The gain is a random effect: Legendre products
    up to degree 4 with standard deviation tau / degree^2, which falls as bending energy demands. The part of the residual that
    the lights cannot imitate gives tau per channel by the method of moments. The effect of such a gain on the lights adds to
    the Gauss-Newton covariance. Where only noise is left, tau = 0 and nothing is added.

    Source:
        Searle, Casella, McCulloch, Variance Components, 1992 (Henderson's method 3); Bjorck, Numerical Methods for Least
        Squares Problems, 1996, for the covariance.
    """
    pixels = fit.pixels
    u, v = pixels.x / pixels.x.abs().max(), pixels.y / pixels.y.abs().max()
    relative = pixels.exponent * pixels.model(fit.parameter) / pixels.noise[:, None]  # residual per relative gain
    in_u, in_v = _legendre(u), _legendre(v)
    orders = [(i, j) for i in range(5) for j in range(5 - i) if i + j > 0]
    gain = torch.stack([in_u[i] * in_v[j] / (i + j) ** 2 for i, j in orders])  # (14, N)
    covariances, misfits = [], []
    k = fit.jacobian.shape[1]
    for c in range(3):
        # only products of columns are needed: those of the parameters (K), the gains (14) and the residual (1)
        columns = torch.cat((fit.jacobian[c], gain * relative[c], fit.residual[c : c + 1]))
        product = (columns * fit.weight[c]) @ columns.t()
        inverse, shared = _inverse(product[:k, :k]), product[:k, k:-1]
        carried = inverse @ shared  # change of the parameters where the gain exists and is not in the model
        free = product[k:-1, k:-1] - shared.t() @ carried
        left = product[k:-1, -1] - carried.t() @ product[:k, -1]
        explained = left @ torch.linalg.pinv(free, rtol=1e-10, hermitian=True) @ left
        tau_squared = ((explained - gain.shape[0]) / torch.trace(free)).clamp_min(0.0)
        covariances.append(inverse + tau_squared * carried @ carried.t())
        misfits.append(tau_squared.sqrt())
    return torch.stack(covariances), torch.stack(misfits)


def direction_and_position_std(parameter: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations of each light's direction (deg, (3,)) and position (mm, (3, 3))."""
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    to_mm = torch.ones(3, 3, dtype=parameter.dtype)
    to_mm[:, 2] = position[:, 2]
    covariance_mm = covariance[:, :3, :3] * to_mm[:, :, None] * to_mm[:, None, :]
    distance = position.norm(dim=1)
    direction = position / distance[:, None]
    across = torch.eye(3, dtype=parameter.dtype) - direction[:, :, None] * direction[:, None, :]
    variance = torch.diagonal(across @ covariance_mm @ across, dim1=1, dim2=2).sum(1)
    direction_std = torch.rad2deg(variance.clamp_min(0).sqrt() / distance).clamp_max(90.0)
    return direction_std, torch.diagonal(covariance_mm, dim1=1, dim2=2).clamp_min(0).sqrt()


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse of a normal matrix; directions that the image does not constrain get a huge variance."""
    size = torch.diagonal(matrix).clamp_min(1e-20).sqrt()
    values, vectors = torch.linalg.eigh(matrix / (size[:, None] * size))
    inverse: Tensor = (vectors / values.clamp_min(1e-13)) @ vectors.t() / (size[:, None] * size)
    return inverse


def _legendre(t: Tensor) -> list[Tensor]:
    return [torch.ones_like(t), t, 1.5 * t**2 - 0.5, 2.5 * t**3 - 1.5 * t, (35 * t**4 - 30 * t**2 + 3) / 8]
