"""Calibrate a unit from one image without contact, and from presses of balls or touches by any object, if there are any.

python scripts/calibrate.py background.png --sensor gelsight_mini --out unit.safetensors
python scripts/calibrate.py background.png --mm-per-pixel 0.05 --out unit.safetensors
python scripts/calibrate.py background.png --press 1.png 6.31 --press 2.png 6.31 --sensor gelsight_mini --out unit.safetensors
python scripts/calibrate.py FOLDER --sensor gelsight_mini --out unit.safetensors

The background is one image, several (their median), or a video whose first frames show the skin without contact.
FOLDER is a calibration folder of gs_sdk: catalog.csv, background.png, N/gelsight.png. Centers of the balls are found.
"""

import argparse
import dataclasses
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch

import torchvts as vts
from torchvts.core.files import read_frames
from torchvts.model.report import CandidateRow, PressRow, Report
from torchvts.stream import FIRST_FRAMES, read_background, read_press_images


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("background", type=Path, nargs="+", help="image without contact, several, a video, or a folder of gs_sdk")
    parser.add_argument("--sensor", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--mm-per-pixel", type=float, help="instead of --sensor: pixel pitch of an unknown sensor")
    parser.add_argument("--gamma", type=float, help="with --mm-per-pixel: value = light^(1/gamma); chosen if not given")
    parser.add_argument("--background-frames", type=int, default=FIRST_FRAMES, help="of a video: first frames without contact")
    parser.add_argument(
        "--press", nargs=2, action="append", default=[], metavar=("IMAGE", "MM"), help="a ball pressed in, and its diameter"
    )
    parser.add_argument("--touches", type=Path, nargs="+", default=[], help="images of unknown objects pressed in")
    parser.add_argument(
        "--use-labels", action="store_true", help="use centers of the folder's label.npz or labels.csv instead of finding them"
    )
    parser.add_argument("--no-prior", action="store_true", help="ignore the prior of the sensor file")
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write, .safetensors")
    arguments = parser.parse_args(argv)
    if (arguments.sensor is None) == (arguments.mm_per_pixel is None):
        parser.error("give either --sensor or --mm-per-pixel")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    image, sensor, presses = read_given(arguments, parser)
    presses += read_press_images(arguments.press, sensor)
    touches = [vts.Touch(sensor.read_image(path), None, path.name) for path in arguments.touches]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", vts.CalibrationWarning)
        calibration = vts.calibrate(image, sensor, presses, touches, progress=True)
    calibration.save(arguments.out)
    report, sensor = calibration.report, calibration.sensor
    print(f"sensor {sensor.name}: {sensor.height} x {sensor.width} px, {sensor.mm_per_pixel} mm per pixel, gamma {sensor.exponent}")
    print(f"chosen: {report['model']} ({report['source']}): {report['reason']}\n")
    print_candidates(report["candidates"])
    if report["model"] == "point_lights" and calibration.lights is not None:
        print_lights(calibration.lights, report)
    if "presses" in report:
        print_presses(report["presses"])
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    print(f"wrote {arguments.out} ({arguments.out.stat().st_size / 1000:.0f} kB)")
    return 0


def read_given(arguments: argparse.Namespace, parser: argparse.ArgumentParser) -> tuple[torch.Tensor, vts.Sensor, list[vts.Press]]:
    """Background, sensor and presses that the arguments name."""
    first = arguments.background[0]
    sensor = vts.Sensor.load(arguments.sensor) if arguments.sensor is not None else unknown_sensor(arguments)
    sensor = sensor.without_prior() if arguments.no_prior else sensor
    if not (len(arguments.background) == 1 and first.is_dir()):
        return read_background(arguments.background, sensor, arguments.background_frames), sensor, []
    image, presses = vts.read_presses(first)
    if not arguments.use_labels:
        presses = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]
    elif all(press.center_px is None for press in presses):
        parser.error(f"--use-labels: {first} has neither label.npz nor labels.csv: leave --use-labels out, centers are found")
    elif tuple(image.shape[1:]) != (sensor.height, sensor.width):
        parser.error(f"--use-labels: the images of {first} are raw frames, labels are for cropped ones: leave --use-labels out")
    presses = [dataclasses.replace(press, image=sensor.rectify(press.image[None])[0]) for press in presses]
    return sensor.rectify(image[None])[0], sensor, presses


def unknown_sensor(arguments: argparse.Namespace) -> vts.Sensor:
    """The sensor of which only the pitch is known: its images have the size of the background."""
    path = arguments.background[0] / "background.png" if arguments.background[0].is_dir() else arguments.background[0]
    _, image = next(iter(read_frames(path)))
    name, pitch = arguments.background[0].stem or "sensor", arguments.mm_per_pixel
    return vts.Sensor(name, image.shape[1], image.shape[2], pitch, gamma=arguments.gamma)


def print_candidates(candidates: list[CandidateRow]) -> None:
    print("| model | family | passes | parameters | deg | misfit | note |\n|---|---|---|---|---|---|---|")
    for row in candidates:
        score = "" if row["score_deg"] is None else f"{row['score_deg']:.2f}"
        misfit = f"{row['misfit']:.1%}" if "misfit" in row else ""
        family = row.get("family", "") + (f", gamma {row['gamma']:g}" if row.get("gamma", 1.0) != 1.0 else "")
        print(f"| {row['model']} | {family} | {row['passes']} | {row['parameters']} | {score} | {misfit} | {row.get('note', '')} |")
    print("deg: mean angle on held-out presses; for point lights without presses the standard deviation of the worst direction")
    print("misfit: smooth relative structure of the image that the lights leave unexplained\n")


def print_lights(lights: vts.PointLights, report: Report) -> None:
    print("| light | x mm | y mm | z mm | direction +- deg | gloss |\n|---|---|---|---|---|---|")
    position, gloss = lights.position_mm.tolist(), lights.gloss.tolist()
    for j, name in enumerate("RGB"):
        spread = f"{report['direction_std_deg'][j]:.2f}" if "direction_std_deg" in report else "given"
        print(f"| {name} | " + " | ".join(f"{v:.2f}" for v in position[j]) + f" | {spread} | {gloss[j]:.3f} |")
    print()


def print_presses(presses: list[PressRow]) -> None:
    print("| press | center px | contact radius px | error deg | times as wide as given | |\n|---|---|---|---|---|---|")
    for press in presses:
        center = ", ".join(f"{v:.1f}" for v in press["center_px"]) if "center_px" in press else ""
        radius = f"{press['contact_radius_px']:.1f}" if "contact_radius_px" in press else ""
        off = f"{press['error_deg']:.1f}" if "error_deg" in press else ""
        wide = f"{1.0 / max(press['gain'], 1e-3):.2f}" if "gain" in press else ""
        print(f"| {press['name']} | {center} | {radius} | {off} | {wide} | {press['reason'] and 'left out: ' + press['reason']} |")
    print("error, times as wide: slopes by the field of the other presses, or by the prior, compared with the ball's\n")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
