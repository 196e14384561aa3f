"""Calibrate a unit from one image without contact.

python scripts/calibrate.py background.png --sensor tacto --out unit.safetensors
python scripts/calibrate.py background.png --mm-per-pixel 0.05 --out unit.safetensors
"""

import argparse
import sys
import warnings
from pathlib import Path

import torchvts as vts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("background", type=Path, help="image of the sensor at rest")
    parser.add_argument("--sensor", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--mm-per-pixel", type=float, help="in place of --sensor: pixel pitch of an unknown sensor")
    parser.add_argument("--gamma", type=float, default=1.0, help="with --mm-per-pixel: value = light^(1/gamma)")
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write, .safetensors")
    arguments = parser.parse_args()
    if (arguments.sensor is None) == (arguments.mm_per_pixel is None):
        parser.error("give either --sensor or --mm-per-pixel")
    image = vts.read_image(arguments.background)
    if arguments.sensor is not None:
        sensor = vts.Sensor.load(arguments.sensor)
        image = sensor.rectify(image[None])[0]
    else:
        sensor = vts.Sensor(arguments.background.stem, *image.shape[1:], arguments.mm_per_pixel, gamma=arguments.gamma)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", vts.CalibrationWarning)
        calibration = vts.calibrate(image, sensor, progress=True)
    calibration.save(arguments.out)
    report = calibration.report
    print(f"sensor {sensor.name}: {sensor.height} x {sensor.width} px, {sensor.mm_per_pixel} mm a pixel, gamma {sensor.gamma}")
    print(f"model {report['model']}, lights {report['lights']}: {report.get('message', '')}")
    print("| light | x mm | y mm | z mm | direction +- deg | gloss |\n|---|---|---|---|---|---|")
    position, gloss = calibration.lights.position_mm.tolist(), calibration.lights.gloss.tolist()
    for j, name in enumerate("RGB"):
        spread = f"{report['direction_std_deg'][j]:.2f}" if "direction_std_deg" in report else "given"
        print(f"| {name} | " + " | ".join(f"{v:.2f}" for v in position[j]) + f" | {spread} | {gloss[j]:.3f} |")
    print(f"noise {max(calibration.noise_std.tolist()):.4f}, residual {max(report['residual_std']):.4f} of full scale")
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    print(f"wrote {arguments.out}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
