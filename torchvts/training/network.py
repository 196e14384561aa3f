"""Trains :class:`torchvts.NormalFromMLP` on pixels of known slope."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ..core.checks import check_field, check_float_tensor, check_integer, check_least, check_range, check_shape, check_switch
from ..core.geometry import MAX_SLOPE
from ..normals import NormalFromMLP


@dataclass(frozen=True, eq=False)
class MlpFit:
    """A trained network and the course of its training.

    Attributes:
        module: the network of the best epoch, in eval mode, its weights frozen.
        history: per epoch (training, held-out) root mean square error of the angles, degrees.
        best_epoch: index into ``history``.
        converged: whether the held-out error stopped falling before ``max_epochs``.
        message: what happened, and the remedy.
    """

    module: NormalFromMLP
    history: list[tuple[float, float]]
    best_epoch: int
    converged: bool
    message: str


class _Samples(NamedTuple):
    """Inputs (N, 5) of the network and angles (N, 2), for training and held out, and the number of presses and of held-out ones."""

    train: tuple[Tensor, Tensor]
    held_out: tuple[Tensor, Tensor]
    presses: int
    presses_held_out: int


class _Schedule(NamedTuple):
    """How long and in which steps to train."""

    max_epochs: int
    patience: int
    batch_size: int
    weight_decay: float
    progress: bool


def fit_mlp(
    intensity: Tensor,
    xy: Tensor,
    slope: Tensor,
    flat: Tensor,
    *,
    groups: Tensor,
    hidden: Sequence[int] = (32, 32, 32),
    seed: int = 0,
    max_epochs: int = 60,
    patience: int = 10,
    batch_size: int = 256,
    held_out: float = 0.15,
    weight_decay: float = 0.2,
    progress: bool = False,
    input_domain: str = "image",
    blur_px: float = 0.0,
) -> MlpFit:
    """Train :class:`NormalFromMLP` on pixels of known slope, such as those inside presses of a ball.

    AdamW on the mean square error of the two angles. Pixels of the flat skin are added with slope 0, one for every two samples, so
    that the network learns the undeformed skin everywhere in the image. Whole presses are held out, because pixels of one press
    resemble each other; the epoch with the smallest held-out error is kept. The step size is halved where that error stalls. The
    same arguments give the same network on the same machine; the global generator is not used.

    Args:
        intensity: (N, 3), R, G, B in [0, 1], preprocessed (blur, compensation) as the images will be.
        xy: (N, 2), column and row of each pixel.
        slope: (N, 2), true (dz/dx, dz/dy), mm per mm.
        flat: (3, H, W), image of the flat skin, preprocessed likewise.
        groups: (N,), number of the press to which each pixel belongs.
        hidden: widths of the hidden layers.
        seed: of weights, order and held-out presses.
        max_epochs: largest number of epochs.
        patience: epochs without a smaller held-out error before training stops.
        batch_size: pixels per step.
        held_out: share of the presses to hold out; at least one press.
        weight_decay: pull of the weights towards 0 (AdamW). A few dozen presses leave most places of the image without one; on a
            GelSight Mini the error on unseen presses is 3.0 to 3.3 degrees at 0.2, 5 without.
        progress: show a bar.
        input_domain: what the preprocessed images are, a key of ``torchvts.normals.DOMAINS``; kept with the network.
        blur_px: blur that belongs to the preprocessing, pixels; kept with the network.
    Returns:
        A :class:`MlpFit`; ``message`` gives the remedy where it did not converge.
    Raises:
        ValueError: wrong shapes, values that are not finite or out of range, fewer than two presses.
        TypeError: wrong dtype.
    Source:
        Wang, She, Romero, Adelson, ICRA 2021, for network and inputs; Loshchilov, Hutter, ICLR 2019, for AdamW.
    """
    _check_samples(intensity, xy, slope, groups)
    check_switch("progress", progress)
    for name, value in (("max_epochs", max_epochs), ("patience", patience), ("batch_size", batch_size)):
        check_integer(name, value, 1)
    check_least("weight_decay", weight_decay), check_least("held_out", held_out, 0.0, 1.0)
    if not 0.0 < held_out < 1.0:
        raise ValueError(f"held_out: expected a share of the presses in (0, 1), got {held_out}")
    check_field("flat", flat)
    module = NormalFromMLP(flat.shape[1], flat.shape[2], flat, hidden, seed=seed, input_domain=input_domain, blur_px=blur_px)
    _check_places(xy, flat)
    generator = torch.Generator().manual_seed(seed)
    samples = _split((intensity, xy, slope), flat, groups, held_out, generator)

    # inputs of mean 0 and deviation 1 train faster; the first layer takes the scale up again below
    mean, std = samples.train[0].mean(0), samples.train[0].std(0).clamp_min(1e-3)
    train, held = (((feature - mean) / std, angle) for feature, angle in (samples.train, samples.held_out))
    parameters = [parameter.detach().clone().requires_grad_(True) for parameter in module.layers.parameters()]
    schedule = _Schedule(max_epochs, patience, batch_size, weight_decay, progress)
    best, best_epoch, history = _train(parameters, train, held, schedule, generator)

    best[0] = best[0] / std
    best[1] = best[1] - best[0] @ mean
    with torch.no_grad():
        for weight, trained in zip(module.layers.parameters(), best, strict=True):
            weight.copy_(trained)
    module.set_flat(module.flat)
    converged = len(history) - 1 - best_epoch >= patience
    score = f"{history[best_epoch][1]:.2f} degrees on {samples.presses_held_out} of {samples.presses} presses held out"
    message = f"held-out error stopped falling after epoch {best_epoch + 1}: {score}"
    if not converged:
        message = f"stopped at {len(history)} epochs, held-out error may still fall: {score}: raise max_epochs"
    return MlpFit(module.requires_grad_(False).eval(), history, best_epoch, converged, message)


def _split(
    pixels: tuple[Tensor, Tensor, Tensor], flat: Tensor, groups: Tensor, held_out: float, generator: torch.Generator
) -> _Samples:
    """The network's inputs and angles of pixels (intensity, xy, slope): whole presses held out, the flat skin added to the rest."""
    intensity, xy, slope = pixels
    height, width = flat.shape[1], flat.shape[2]
    # gs_sdk's inputs and sense: B, G, R, x, y; H = -z
    extent = torch.tensor([width, height], dtype=flat.dtype)
    feature = torch.cat((intensity.flip(1).to(flat.dtype), xy.to(flat.dtype) / extent), dim=1)
    angle = torch.atan(-slope.to(flat.dtype))
    presses = torch.unique(groups)
    if presses.numel() < 2:
        raise ValueError(f"groups: expected two presses or more, got {presses.numel()}: one is held out to know when to stop")
    count = min(presses.numel() - 1, max(1, round(held_out * presses.numel())))
    chosen = presses[torch.randperm(presses.numel(), generator=generator)[:count]]
    is_held = torch.isin(groups, chosen)
    skin = torch.randint(height * width, (max(1, feature.shape[0] // 2),), generator=generator)
    row, column = skin // width, skin % width
    place = torch.stack((column, row), dim=1).to(flat.dtype) / extent
    skin_feature = torch.cat((flat.detach().flip(0)[:, row, column].T, place), dim=1)
    train_feature = torch.cat((feature[~is_held], skin_feature))
    train_angle = torch.cat((angle[~is_held], angle.new_zeros(skin.numel(), 2)))
    return _Samples((train_feature, train_angle), (feature[is_held], angle[is_held]), presses.numel(), count)


def _train(
    parameters: list[Tensor],
    train: tuple[Tensor, Tensor],
    held_out: tuple[Tensor, Tensor],
    schedule: _Schedule,
    generator: torch.Generator,
) -> tuple[list[Tensor], int, list[tuple[float, float]]]:
    """Parameters of the epoch with the smallest held-out error, that epoch, and the history of errors, degrees."""
    optimiser = torch.optim.AdamW(parameters, lr=3e-3, weight_decay=schedule.weight_decay)
    rate = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=max(1, schedule.patience // 4), threshold=0.0)
    history: list[tuple[float, float]] = []
    best, best_epoch = [parameter.detach().clone() for parameter in parameters], -1
    feature, angle = train
    total = feature.shape[0]
    with tqdm(
        total=schedule.max_epochs, desc=f"network, {total} pixels", disable=not schedule.progress or None, leave=False
    ) as bar:
        for epoch in range(schedule.max_epochs):
            squares = 0.0
            for part in torch.split(torch.randperm(total, generator=generator), schedule.batch_size):
                loss = nn.functional.mse_loss(_run(parameters, feature[part]), angle[part])
                for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
                    parameter.grad = gradient
                optimiser.step()
                squares += float(loss.detach()) * part.numel()
            with torch.no_grad():
                error = float(nn.functional.mse_loss(_run(parameters, held_out[0]), held_out[1]))
            history.append((math.degrees(math.sqrt(squares / total)), math.degrees(math.sqrt(error))))
            rate.step(error)
            bar.update()
            bar.set_postfix(held_out=f"{history[-1][1]:.2f} deg")
            if best_epoch < 0 or history[-1][1] < history[best_epoch][1]:
                best, best_epoch = [parameter.detach().clone() for parameter in parameters], epoch
            elif epoch - best_epoch >= schedule.patience:
                break
    return best, best_epoch, history


def _run(parameters: Sequence[Tensor], feature: Tensor) -> Tensor:
    value = feature
    for k in range(0, len(parameters), 2):
        value = nn.functional.linear(torch.relu(value) if k else value, parameters[k], parameters[k + 1])
    return value


def _check_places(xy: Tensor, flat: Tensor) -> None:
    height, width = flat.shape[1], flat.shape[2]
    low, high = xy.amin(0).tolist(), xy.amax(0).tolist()
    if min(low) < 0 or high[0] > width - 1 or high[1] > height - 1:
        raise ValueError(
            f"xy: expected columns in [0, {width - 1}] and rows in [0, {height - 1}] like flat, "
            f"got x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}: x stands first"
        )


def _check_samples(intensity: Tensor, xy: Tensor, slope: Tensor, groups: Tensor) -> None:
    check_float_tensor("intensity", intensity)
    count = intensity.shape[0] if intensity.dim() == 2 else 0
    if count == 0 or intensity.shape[1] != 3:
        raise ValueError(f"intensity: expected (N, 3), R, G, B of each pixel, got {tuple(intensity.shape)}")
    for name, values, shape in (("xy", xy, (count, 2)), ("slope", slope, (count, 2)), ("groups", groups, (count,))):
        check_shape(name, values, shape, "the pixels of intensity")
    check_float_tensor("slope", slope)
    if xy.is_complex() or (xy.is_floating_point() and xy.dtype not in (torch.float32, torch.float64)):
        raise TypeError(f"xy: expected columns and rows as integers, float32 or float64, got {xy.dtype}")
    if groups.dtype not in (torch.int64, torch.int32):
        raise TypeError(f"groups: expected int64, the press of each pixel, got {groups.dtype}")
    check_range("intensity", intensity)
    if not bool(torch.isfinite(xy.double()).all()):
        raise ValueError("xy: expected finite pixels, got NaN or infinite")
    steepest = float(slope.abs().max())
    if not steepest <= MAX_SLOPE:
        raise ValueError(
            f"slope: expected finite slopes up to {MAX_SLOPE:.1f}, got {steepest:.4g}: "
            "keep 3 pixels inside the rim of the ball's contact"
        )
