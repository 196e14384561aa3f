"""Errors of the slopes of real sensors, by presses of balls that were not calibrated from: size, and correlation between presses.

python scripts/slope_errors.py --sets gelsight_mini_a gelsight_mini_c digit_a

Half of the presses are calibrated from and the other half measured, and the other way round. docs/tracking.md
has the table; scripts/lab/tracking.py draws errors that have these covariances.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lab import sets
from lab.commands import main_of, parser_of
from torchvts.pipeline import DepthPipeline
from torchvts.training.presses import Training

PIXELS = 350  # of each press
DISTANCES_MM = (0.4, 0.8, 1.3, 2.0, 3.0, 4.5, 7.0)
SLOPES = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.9)


class Errors(NamedTuple):
    """Pixels of a press inside its contact: place (N, 2) mm, error of the slope (N, 2), true slope (N, 2), and its fold."""

    place: Tensor
    error: Tensor
    slope: Tensor
    fold: int


def measure(name: str, data: Path) -> list[Errors]:
    """Errors of all presses that can be scored."""
    found, loaded = [], sets.load(name, data)
    folds = loaded.folds
    if len(folds) != 2:  # halves, so that there are many pairs of presses; a prior of the set's own presses has seen some of them
        targets = {target.name: target for fold in folds for target in fold.scored}
        presses = list({press.name: press for fold in folds for press in fold.learned}.values())
        known = [targets[press.name] for press in presses if press.name in targets]
        folds = sets.cross_validation(folds[0].sensor.without_prior(), presses, known, 2)
    for index, fold in enumerate(folds):
        pipe = DepthPipeline.from_calibration(Training(loaded.background, fold.learned, fold.sensor).calibration)
        for target in fold.scored:
            if target.truth is None or int(target.truth.region.sum()) < 200:
                continue
            with torch.inference_mode():
                gradient = pipe(target.image[None]).gradient.double()
            row, column = torch.nonzero(target.truth.region[0, 0], as_tuple=True)
            true = target.truth.gradient[0, :, row, column].T
            place = fold.sensor.mm_per_pixel * torch.stack((column, row), 1).double()
            found.append(Errors(place, gradient[0, :, row, column].T - true, true, index))
    return found


def without_centre(press: Errors) -> Errors:
    """The error without what a wrong centre of the ball explains: the ball's slope g changes by (I + g g^T) sqrt(1 + |g|^2)."""
    g = press.slope
    shape = torch.eye(2, dtype=g.dtype) + g[:, :, None] * g[:, None]
    jacobian = (shape * (1.0 + g.square().sum(1)).sqrt()[:, None, None]).reshape(-1, 2)
    shift = torch.linalg.lstsq(jacobian, press.error.reshape(-1, 1)).solution
    return press._replace(error=press.error - (jacobian @ shift).reshape(-1, 2))


def without_gain(presses: Sequence[Errors]) -> list[Errors]:
    """The errors without the part along the slope that is one function of the slope's size: it moves with the object."""
    size = [press.slope.norm(dim=1).clamp_min(1e-6) for press in presses]
    along = torch.cat([(p.error * p.slope).sum(1) / s for p, s in zip(presses, size, strict=True)])
    cell = (torch.cat(size) / 0.08).long()
    mean = torch.zeros(int(cell.max()) + 1, dtype=along.dtype).scatter_reduce_(0, cell, along, "mean", include_self=False)
    return [
        p._replace(error=p.error - (mean[(s / 0.08).long()] / s)[:, None] * p.slope) for p, s in zip(presses, size, strict=True)
    ]


def correlations(presses: Sequence[Errors]) -> Tensor:
    """Mean product of errors in two presses, by distance of the pixels and by difference of the slopes, per mean square error."""
    bounds = torch.tensor(DISTANCES_MM, dtype=torch.float64), torch.tensor(SLOPES[1:], dtype=torch.float64)
    total = torch.zeros(2, (len(DISTANCES_MM) + 1) * len(SLOPES), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    some = [torch.randperm(len(press.place), generator=generator)[:PIXELS] for press in presses]
    for i, one in enumerate(presses):
        for k in range(i):
            other = presses[k]
            if one.fold != other.fold:
                continue
            far = torch.bucketize(torch.cdist(one.place[some[i]], other.place[some[k]]), bounds[0])
            steep = torch.bucketize(torch.cdist(one.slope[some[i]], other.slope[some[k]]), bounds[1])
            product = one.error[some[i]] @ other.error[some[k]].T
            cell = (far * len(SLOPES) + steep).flatten()
            total[0] += torch.bincount(cell, product.flatten(), total.shape[1])
            total[1] += torch.bincount(cell, minlength=total.shape[1])
    square = torch.stack([press.error.square().sum(1).mean() for press in presses]).mean()
    mean = torch.where(total[1] > 200, total[0] / total[1].clamp_min(1.0) / square, torch.nan)
    return mean.reshape(-1, len(SLOPES))[:-1, :-1]


def degrees(presses: Sequence[Errors]) -> float:
    """Root mean square error, degrees."""
    return math.degrees(math.atan(float(torch.stack([p.error.square().sum(1).mean() for p in presses]).mean().sqrt())))


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--sets", nargs="+", default=["gelsight_mini_a", "gelsight_mini_c", "digit_a"], choices=list(sets.REAL))
    parser.add_argument("--data", type=Path, default=sets.data_folder(), help="folder of the real sensors")
    arguments = parser.parse_args(argv)
    for name in arguments.sets:
        presses = measure(name, arguments.data)
        constant = torch.stack([p.error.mean(0).square().sum() for p in presses]).mean()
        share = float(constant / torch.stack([p.error.square().sum(1).mean() for p in presses]).mean())
        print(f"{name}: {len(presses)} presses, {degrees(presses):.1f} degrees, constant over a contact {share:.2f} of the square")
        for kind, some in (("centres as labelled", presses), ("centres fitted", [without_centre(p) for p in presses])):
            even = without_gain(some)
            print(f"  {kind}, without a gain: {degrees(even):.1f} degrees; mm to the next line, slopes to {SLOPES[1:]}")
            for distance, line in zip(DISTANCES_MM, correlations(even), strict=True):
                print(f"  {distance:4.1f}  " + " ".join("  .  " if math.isnan(v) else f"{v:5.2f}" for v in line.tolist()))
    return 0


if __name__ == "__main__":
    main_of(main)
