"""Calibrate and reconstruct: real images where they are, and a rendered scene whose truth is known.

python scripts/demo.py [--out out/demo]

Real images are those that `torchvts samples gelsight_mini` fetched into the cache; without them those in the folder TORCHVTS_DATA
or in ../shared/data; without these, only the rendered scene.
"""

import dataclasses
import statistics
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import kornia
import torch
from tqdm import tqdm

import torchvts as vts
from lab import metrics
from lab.commands import main_of, parser_of
from lab.sets import data_folder
from torchvts import scenes, viz
from torchvts.samples import cached_sample

PITCH = 0.0625


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    sample, folder = cached_sample("gelsight_mini"), data_folder()
    if sample is not None:
        print(f"real images: the sample gelsight_mini, in {sample}")
        lines = real(sample.parent, [(sample.name, "gelsight_mini", "background.png", SAMPLE_PRESSES)], arguments.out)
    elif folder.is_dir():
        print(f"real images: {folder}")
        lines = real(folder, CASES, arguments.out)
    else:
        print("real images: none; only the rendered scene (torchvts samples gelsight_mini fetches some)")
        lines = []
    lines += embedded(arguments.out)
    print("\n".join(lines))
    print(f"\npictures in {arguments.out}")
    return 0


def embedded(out: Path) -> list[str]:
    """A rendered sensor with low lights, a worn skin, noise and 8 bits, calibrated from one image."""
    lights = vts.PointLights([[20.0, 9.3, 16.5], [-18.0, 12.6, 15.5], [-1.9, -21.9, 17.5]], [200.0, 200.0, 200.0])
    sensor = vts.Sensor("embedded", 480, 640, PITCH)
    worn = scenes.skin_spots(480, 640)
    undeformed = scenes.undeformed(scenes.sphere_press())
    background = scenes.render(undeformed, lights, noise_std=0.01, bits=8, spots=worn, seed=1)[0].detach()
    start = time.perf_counter()
    calibration = vts.calibrate(background, sensor, progress=True)
    seconds = time.perf_counter() - start
    calibration.save(out / "embedded.safetensors")
    calibration = vts.Calibration.load(out / "embedded.safetensors")
    off = float((calibration.lights.position_mm - lights.position_mm).abs().max().detach())
    lines = [
        f"Rendered scene: 640 x 480, noise 0.01, 8 bits, spots; lights found within {off:.3f} mm in {seconds:.1f} s",
        "",
        "| press | mode | largest error px | RMS px | normals deg | moved skin IoU |",
        "|---|---|---|---|---|---|",
    ]
    presses = {
        "sphere": scenes.sphere_press(10.0, 1.0, center_mm=(-3.0, 2.0)),
        "letters": scenes.letters_press("VTS", 0.5, bevel_mm=0.9),
        "texture": scenes.sine_press(),
        "cylinder": scenes.cylinder_press(),
    }
    for number, (name, scene) in enumerate(tqdm(presses.items(), desc="presses", leave=False, disable=None)):
        image = scenes.render(scene, lights, noise_std=0.01, bits=8, spots=worn, seed=2 + number).detach()
        for mode in ("fast", "precise"):
            with torch.inference_mode():
                result = vts.DepthPipeline.from_calibration(calibration, mode)(image)
            error = metrics.depth_error(result.depth_mm, scene.depth_mm, PITCH)
            angle = float(metrics.normal_angle_deg(result.normal, scene.normal, scene.contact).mean())
            iou = metrics.mask_iou(result.deformed, scene.contact)  # a scene's mask holds all pixels that have depth
            lines.append(f"| {name} | {mode} | {error.max_px:.3f} | {error.rms_px:.4f} | {angle:.2f} | {iou:.3f} |")
        viz.save_figure(viz.depth_figure(result.depth_mm, PITCH, image, result.contact, f"{name}, {mode}"), out / f"{name}.png")
        viz.save_figure(viz.comparison_figure(result.depth_mm, scene.depth_mm, PITCH, f"{name}, {mode}"), out / f"{name}_error.png")
    return [*lines, ""]


SAMPLE_PRESSES = ["6.310mm/0/gelsight.png", "9.500mm/4/gelsight.png"]
CASES = [
    ("gelsight_mini_a", "gelsight_mini", "background.png", ["6.310mm/0/gelsight.png"]),
    ("gelsight_mini_b", "gelsight_mini", "background.png", ["bead.png"]),
]
"""Folder of a sensor, its sensor file, its background, images to reconstruct."""


def real(folder: Path, cases: list[tuple[str, str, str, list[str]]], out: Path) -> list[str]:
    """Photographs by others, each sensor calibrated from its background, one also from a few presses."""
    lines = [
        f"Images of {folder.name}/, each sensor calibrated from its one background",
        "",
        "| image | model | deepest mm | contact mm^2 |",
        "|---|---|---|---|",
    ]
    notes = []
    for place, sensor_name, background, images in cases:
        if not (folder / place / background).is_file():
            lines.append(f"| {place} | not there | | |")
            continue
        sensor = vts.Sensor.load(sensor_name)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", vts.CalibrationWarning)
            calibration = vts.calibrate(vts.read_image(folder / place / background), sensor, progress=True)
        notes += [f"{place}: {warning.message}" for warning in caught]
        pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
        model = {"point_lights": "point lights", "response": "prior of the sensor type"}[calibration.report["model"]]
        for name in images:
            if not (folder / place / name).is_file():
                continue
            image = vts.read_image(folder / place / name)[None]
            with torch.inference_mode():
                result = pipe(image)
            area = float(result.contact.double().sum()) * sensor.mm_per_pixel**2
            lines.append(f"| {place}/{name} | {model} | {float(result.depth_mm.max()):.3f} | {area:.1f} |")
            title = f"{place}/{name}, {model}"
            picture = f"{place}_{Path(name).with_suffix('')}".replace("/", "_")
            viz.save_figure(
                viz.depth_figure(result.depth_mm, sensor.mm_per_pixel, image, result.contact, title), out / f"{picture}.png"
            )
    if (folder / "gelslim_markers" / "ref.jpg").is_file():
        lines += marked(folder / "gelslim_markers", out)
    return lines + (["", "Warnings of these calibrations:"] + [f"* {note}" for note in notes] if notes else [])


def marked(folder: Path, out: Path) -> list[str]:
    """A lab sensor with printed markers, calibrated from four presses; depth with the markers filled and with them left in.

    Pitch and ball diameter are unknown. 0.05 mm and 5 mm are assumed, so the depth has no true scale.
    """
    background = vts.read_image(folder / "ref.jpg")
    sensor = vts.Sensor("lab sensor with markers", background.shape[1], background.shape[2], 0.05, markers=True)
    names = ["sample_8", "sample_13", "sample_34", "sample_43"]
    images = [vts.read_image(folder / f"{name}.jpg") for name in names]
    presses = [vts.Press(image, 5.0, name) for image, name in zip(images, names)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        calibration = vts.calibrate(background, sensor, presses, progress=True)
    left_in = vts.Calibration.from_response(calibration.response, dataclasses.replace(sensor, markers=False), background)
    lines = []
    for state, unit in (("markers filled", calibration), ("markers left in", left_in)):
        pipe = vts.DepthPipeline.from_calibration(unit, "fast")
        with torch.inference_mode():
            results = [pipe(image[None]) for image in images]
        dots = statistics.mean(dots_um(result.depth_mm) for result in results)
        deepest = statistics.mean(float(result.depth_mm.max()) for result in results)
        lines.append(
            f"| gelslim_markers, mean of 4 | {len(names)} presses, {state} | {deepest:.3f}, scale assumed | "
            f"dots in the depth: {dots:.1f} um RMS |"
        )
        title = f"gelslim_markers/{names[0]}, {state}"
        figure = viz.depth_figure(results[0].depth_mm, sensor.mm_per_pixel, images[0][None], results[0].contact, title)
        viz.save_figure(figure, out / f"gelslim_{state.replace(' ', '_')}.png")
    return lines


def dots_um(depth_mm: torch.Tensor, spacing_px: float = 22.0) -> float:
    """RMS of depth at scales from a third of the dots' spacing to the spacing itself, over the whole image, micrometres."""
    fine = kornia.filters.gaussian_blur2d(depth_mm, (9, 9), (1.5, 1.5))
    coarse = kornia.filters.gaussian_blur2d(depth_mm, (67, 67), (0.5 * spacing_px, 0.5 * spacing_px))
    return 1000.0 * float((fine - coarse).std())


if __name__ == "__main__":
    main_of(main)
