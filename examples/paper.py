"""The paper: its equations 1 to 11 in order, each on one block of torchvts, and its figure 3, with a table of errors.

Ji, Liu, Ma: Model-Based 3D Contact Geometry Perception for Visual Tactile Sensor, Sensors 2022, 22(17), 6470.

    python examples/paper.py

A ball with a radius of 160 px is pressed 16 and 32 px deep into the spotted skin of a drawn sensor. The sensor is
calibrated from its one image without contact. Depth is found by the fast method (eq. 9) and by the precise one (eq. 10), and
compared with the truth. Lengths are in mm, x points right and y down, z towards the camera; depth is positive where the skin is
pressed in.
"""

import math
from pathlib import Path

import kornia
import torch
from torch import Tensor

import torchvts as vts
from torchvts import scenes, viz

PITCH = 0.0625  # mm per pixel
RADIUS_PX, PRESSES_PX = 160, (16, 32)
IN_THE_PAPER = {16: (0.31, 0.09), 32: (1.21, 0.16)}  # largest error, px, by eq. 9 and by eq. 10
LEAST_CHANGE = 0.005  # of a pixel, from which it counts as moved skin
SPOTS, SPOT_PX, SPOT_DARK = 200, 5, 0.1  # on the skin: their number, width, and the share of one colour that each takes

sensor = vts.Sensor("figure 3", height=480, width=640, mm_per_pixel=PITCH)
ANGLES = [math.radians(10 + 120 * k) for k in range(3)]  # red, green, blue
TRUE_LIGHTS = vts.PointLights([[31.25 * math.cos(a), 31.25 * math.sin(a), 39.375] for a in ANGLES], [1450.0] * 3)
# mm: 500 px out and 630 px high


def ball(radius_px: float, press_px: float) -> scenes.Scene:
    """A ball of a radius, pressed in: exact depth, normals and slopes."""
    return scenes.sphere_press(radius_px * PITCH, press_px * PITCH, height=sensor.height, width=sensor.width, mm_per_pixel=PITCH)


UNDEFORMED = scenes.undeformed(ball(RADIUS_PX, PRESSES_PX[0]))


def image_of(scene: scenes.Scene, lights: vts.PointLights) -> Tensor:
    """The model's image, (1, 3, H, W).

    Eq. 1: a light S with albedo rho gives pixel P with normal n the value I = rho (S - P) . n / |S - P|^3.
    Eq. 2: the three colours together are linear in the normal, I = L n; a row of the 3x3 matrix L is rho (S - P) / |S - P|^3.
    """
    return vts.near_field_shading(scene.depth_mm, scene.normal, lights, PITCH).detach()


def photograph(scene: scenes.Scene) -> Tensor:
    """The camera's image, (1, 3, H, W): what the true lights give, less at coloured spots, which are no part of the model."""
    spots = torch.zeros(1, 3, sensor.height, sensor.width)
    places = torch.randint(spots.numel(), (SPOTS,), generator=torch.Generator().manual_seed(0))
    spots.view(-1)[places] = SPOT_DARK
    spots = torch.nn.functional.max_pool2d(spots, SPOT_PX, 1, SPOT_PX // 2)
    return image_of(scene, TRUE_LIGHTS) * (1.0 - spots)


def normals_of(light: Tensor, lights: vts.PointLights, depth_mm: Tensor | None) -> Tensor:
    """Eq. 3: n = L^-1 I, made unit; L by eq. 9 or by eq. 10."""
    return vts.NormalFromIntensity(lights, sensor.height, sensor.width, PITCH)(light, depth_mm)


def depth_of(gradient: Tensor) -> Tensor:
    """Eq. 4: the Laplacian of z is dp/dx + dq/dy, of the slopes of eq. 5; by a sine transform, with z = 0 on the border."""
    return vts.poisson_dst(gradient, PITCH)


def gradient_of(normal: Tensor) -> Tensor:
    """Eq. 5: the slopes are p = dz/dx = -n_x / n_z and q = dz/dy = -n_y / n_z."""
    return vts.GradientFromNormal()(normal)


def calibrate(background: Tensor) -> tuple[vts.PointLights, Tensor]:
    """Lights with their albedos, 12 numbers, and I_delta, of one image without contact.

    Eq. 6: the lights minimise |model - image|^2, with z = 0 and n = (0, 0, 1) everywhere. Here spots count less (Tukey's loss).
    Eq. 7: I_delta = model - image: here the spots. It is 0 elsewhere.
    """
    lights = vts.fit_lights(background, sensor, gloss=False).lights
    return lights, flat_image(lights) - background


def flat_image(lights: vts.PointLights) -> Tensor:
    """The model's image of the flat skin, (3, H, W)."""
    return image_of(UNDEFORMED, lights)[0]


def contact_area(light: Tensor, lights: vts.PointLights) -> Tensor:
    """Where the image has changed, its holes closed."""
    changed = (light - flat_image(lights)).abs().amax(1, keepdim=True) > LEAST_CHANGE
    return kornia.morphology.closing(changed.float(), torch.ones(25, 25))


def solve(image: Tensor, lights: vts.PointLights, delta: Tensor, depth_mm: Tensor | None) -> Tensor:
    """One pass. Eq. 8: n = L^-1 (I_cont + I_delta), I_cont the image with contact. Then eq. 5, zero slope outside of it, and eq. 4.

    I_delta adds and spots multiply, so that a little of them is left on slopes: without spots eq. 10 is off by 0.11 and 0.16 px.
    """
    light = vts.Compensate(offset=delta)(image)
    return depth_of(gradient_of(normals_of(light, lights, depth_mm)) * contact_area(light, lights))


def fast(image: Tensor, lights: vts.PointLights, delta: Tensor) -> Tensor:
    """Eq. 9: L is that of the flat skin, z = 0."""
    return solve(image, lights, delta, None)


def precise(image: Tensor, lights: vts.PointLights, delta: Tensor) -> Tensor:
    """Eq. 10: L is that of the depth which the fast method has found."""
    return solve(image, lights, delta, fast(image, lights, delta))


def by_table(image: Tensor, lights: vts.PointLights, delta: Tensor) -> Tensor:
    """GelSight's look-up table of slopes by the change of colour, learned from drawn presses of two balls."""
    flat = flat_image(lights)
    presses = [ball(128, 24), ball(80, 16)]
    inside = [press.contact[0, 0] for press in presses]
    changes = [(photograph(press)[0] + delta - flat)[:, seen].T for press, seen in zip(presses, inside)]
    slopes = [press.gradient[0][:, seen].T for press, seen in zip(presses, inside)]
    light = vts.Compensate(offset=delta)(image)
    normal = vts.NormalFromLookup.fit(flat, torch.cat(changes), torch.cat(slopes))(light)
    return depth_of(gradient_of(normal) * contact_area(light, lights))


def rms_difference_px(one_mm: Tensor, other_mm: Tensor) -> float:
    """Eq. 11: the root of the mean squared difference of two depths, in px."""
    return float((one_mm - other_mm).square().mean().sqrt()) / PITCH


def main() -> dict[int, tuple[float, float, float, float]]:
    """Print the table and draw the figure; returns by press, px: largest errors by eq. 9 and 10, and RMS with and without eq. 8."""
    lights, delta = calibrate(photograph(UNDEFORMED)[0])
    print(f"lights found within {(lights.position_mm - TRUE_LIGHTS.position_mm).abs().max():.0e} mm")
    print(
        "| press px | largest px, eq. 9: paper | here | eq. 10: paper | here | its RMS | without eq. 8 | eq. 11: eq. 10 and table |"
    )
    print("|---|---|---|---|---|---|---|---|")
    errors: dict[int, tuple[float, float, float, float]] = {}
    figure = viz.new_figure(9.0, 4.6)
    axes = figure.subplots(len(PRESSES_PX), 3, squeeze=False)
    for row, press_px in zip(axes, PRESSES_PX, strict=True):
        scene = ball(RADIUS_PX, press_px)
        image = photograph(scene)
        depths = [method(image, lights, delta) for method in (fast, precise)]
        maps = [(depth - scene.depth_mm)[0, 0] / PITCH for depth in depths]
        paper, table = IN_THE_PAPER[press_px], by_table(image, lights, delta)
        largest = [float(error.abs().max()) for error in maps]
        without_delta = precise(image, lights, torch.zeros_like(delta))
        errors[press_px] = (*largest, *(rms_difference_px(depth, scene.depth_mm) for depth in (depths[1], without_delta)))
        cells = [f"{v:.2f}" for v in (paper[0], largest[0], paper[1], largest[1])] + [f"{v:.3f}" for v in errors[press_px][2:]]
        print(f"| {press_px} | {' | '.join(cells)} | {rms_difference_px(depths[1], table):.2f} |")
        row[0].imshow(image[0].permute(1, 2, 0).numpy())
        row[0].set_title(f"ball pressed in by {press_px} px")
        for panel, error, most, equation in zip(row[1:], maps, largest, ("eq. 9, fast", "eq. 10, precise")):
            shown = panel.imshow(error.numpy(), cmap="RdBu_r", vmin=-1.25, vmax=1.25)
            panel.set_title(f"{equation}: at most {most:.2f} px")
        for panel in row:
            panel.set_axis_off()
    figure.colorbar(shown, ax=axes, label="px")
    Path("out").mkdir(exist_ok=True)
    viz.save_figure(figure, "out/figure_3.png")
    print("figure: out/figure_3.png")
    return errors


if __name__ == "__main__":
    found_px = main()  # which the tests read
