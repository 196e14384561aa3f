"""Draw README's picture: a ball on a real GelSight Mini: image, depth, normals, surface, and its profile beside the true ball.

The unit is calibrated by its background and presses of the other ball, so nothing was learned from the ball that is drawn. Of its
presses the one is drawn whose normals are off as in the middle of all: half of them are better.

    python scripts/hero.py [--data FOLDER] [--out docs/hero.png]
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LightSource, LinearSegmentedColormap
from matplotlib.figure import Figure

import torchvts as vts
from lab.commands import main_of, parser_of
from lab.score import score_press
from lab.sets import data_folder
from torchvts import viz

BALL_MM = 6.31
HALF_MM = 4.2
SKIN = LinearSegmentedColormap.from_list("skin", ["#9a8f86", "#d9cfc5"])


class Contact(NamedTuple):
    """What is drawn: image and normals (H, W, 3), depth (H, W) in mm, contact (H, W), center in px and radius in mm of the ball;
    its name, and the mean angle of the normals of its depth off the ball's, degrees."""

    name: str
    error_deg: float
    image: Any
    depth_mm: Any
    normal: Any
    contact: Any
    center_px: tuple[float, float]
    radius_mm: float


def reconstruct(folder: Path, sensor: vts.Sensor) -> tuple[Contact, list[float], int]:
    """The contact that is drawn, the errors of all presses of its ball, rising, degrees, and the number of presses learned from."""
    background, presses = vts.read_presses(folder)
    known = [vts.Press(p.image, p.ball_diameter_mm, p.name) for p in presses if p.ball_diameter_mm != BALL_MM]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        calibration = vts.calibrate(background, sensor.without_prior(), known)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode="precise").freeze()
    found = []
    for press in presses:
        if press.ball_diameter_mm != BALL_MM or press.contact_radius_px is None:  # of a few no radius was labelled
            continue
        out = pipe(press.image[None])
        score = score_press(press, out.depth_mm, out.normal, sensor.mm_per_pixel)
        assert press.center_px is not None and score.depth_normal_deg is not None
        center = (float(press.center_px[0]), float(press.center_px[1]))
        image, normal = press.image.permute(1, 2, 0).numpy(), out.normal[0].permute(1, 2, 0).numpy()
        depth, contact = out.depth_mm[0, 0].numpy(), out.contact[0, 0].numpy()
        found.append(Contact(press.name, score.depth_normal_deg, image, depth, normal, contact, center, 0.5 * BALL_MM))
    found.sort(key=lambda contact: contact.error_deg)
    return found[(len(found) - 1) // 2], [contact.error_deg for contact in found], len(known)


def draw(contact: Contact, pitch: float) -> Figure:
    """Image, depth, normals, surface, and the profile through the ball's center; all in mm, cut to the contact."""
    column, row = (round(value) for value in contact.center_px)
    half = round(HALF_MM / pitch)
    cut = np.s_[max(0, row - half) : row + half + 1, max(0, column - half) : column + half + 1]
    depth_mm, inside = contact.depth_mm[cut], contact.contact[cut]
    x = (np.arange(contact.depth_mm.shape[1])[cut[1]] - contact.center_px[0]) * pitch
    y = (np.arange(contact.depth_mm.shape[0])[cut[0]] - contact.center_px[1]) * pitch
    extent = (x[0] - pitch / 2, x[-1] + pitch / 2, y[-1] + pitch / 2, y[0] - pitch / 2)
    figure = viz.new_figure(12.0, 3.0, dpi=125)
    figure.set_layout_engine("constrained", wspace=0.04)
    grid = figure.add_gridspec(2, 4, height_ratios=(2.4, 1.0))
    image, depth, normal = (figure.add_subplot(grid[:, k]) for k in range(3))
    image.imshow(contact.image[cut], extent=extent)
    image.set(title="camera's image", xlabel="x, mm", ylabel="y, mm (down)")
    colors, norm = viz.depth_colors(*viz.depth_range(depth_mm))
    viz.draw_bar(figure, depth, depth.imshow(depth_mm, extent=extent, cmap=colors, norm=norm), "mm")
    depth.contour(x, y, inside, [0.5], colors="#e69f00", linewidths=1.5)
    depth.set(title="depth, contact outlined", xlabel="x, mm")
    normal.imshow(0.5 + 0.5 * contact.normal[cut], extent=extent)
    normal.set(title="normals as colour", xlabel="x, mm")
    _draw_surface(figure.add_subplot(grid[0, 3], projection="3d"), depth_mm, x, y)
    measured, touched = depth_mm[row - max(0, row - half)], inside[row - max(0, row - half)]
    ball = np.sqrt(np.clip(contact.radius_mm**2 - x**2, 0.0, None))
    ball += (measured - ball)[touched].mean()  # labels hold no depth
    profile = figure.add_subplot(grid[1, 3])
    profile.plot(x, np.where(touched, ball, np.nan), color="#e69f00", lw=5, label="true ball")
    profile.plot(x, measured, color="#0072b2", lw=1.6, label="measured")
    profile.set(xlabel="x, mm", ylabel="mm", ylim=(-0.3, 2.3), aspect="equal")
    profile.legend(loc="upper center", ncols=2, fontsize=7, handlelength=1.0, frameon=False, borderpad=0.0, labelspacing=0.2)
    profile.grid(alpha=0.3)
    return figure


def _draw_surface(axes: Any, depth_mm: Any, x: Any, y: Any) -> None:
    """Draw depth as a surface lit from the upper left."""
    pitch = float(x[1] - x[0])
    shades = LightSource(315, 45).shade(depth_mm, cmap=SKIN, dx=pitch, dy=pitch, blend_mode="soft")
    axes.plot_surface(
        *np.meshgrid(x, -y), depth_mm, facecolors=shades, rstride=1, cstride=1, linewidth=0, antialiased=False, shade=False
    )
    axes.set_box_aspect((np.ptp(x), np.ptp(y), np.ptp(depth_mm)), zoom=1.3)
    axes.view_init(elev=35, azim=-60)
    axes.set_axis_off()
    axes.set_title("surface and profile, to scale")


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder that holds gelsight_mini_a/")
    parser.add_argument("--out", type=Path, default=Path("docs/hero.png"))
    arguments = parser.parse_args(argv)
    folder = arguments.data / "gelsight_mini_a"
    if not folder.is_dir():
        parser.error(f"expected presses in {folder}, got no such folder: set TORCHVTS_DATA, or give --data")
    sensor = vts.Sensor.load("gelsight_mini")
    contact, errors, presses = reconstruct(folder, sensor)
    viz.save_figure(draw(contact, sensor.mm_per_pixel), arguments.out)
    print(f"{arguments.out}: press {contact.name}, calibrated by {presses} presses of the other ball")
    number = f"number {errors.index(contact.error_deg) + 1} of {len(errors)}"
    print(f"normals {contact.error_deg:.1f} degrees off, {number} from the best, {errors[0]:.1f}, to the worst, {errors[-1]:.1f}")
    return 0


if __name__ == "__main__":
    main_of(main)
