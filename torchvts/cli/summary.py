"""What a person reads of a calibration: the model, how good it is likely to be, what was left out; candidates on request."""

import sys
import warnings
from collections.abc import Iterator, Sequence

from torch import Tensor

from ..calibration import CalibrationWarning, Press, calibrate
from ..core.tables import markdown, number
from ..diagnose.checks import SATURATED_SHARE
from ..model import Calibration, PointLights, Sensor
from ..model.report import NOT_CHECKED, PressRow, Report
from ..model.stated_error import UNKNOWN_DEG, press_next
from ..stream import NOT_METRIC

SHOWN = 5
"""Of a list, so many lines are printed."""

BY = {
    "given": "given",
    "sensor_file": "positions from the sensor file",
    "background": "fitted to the image without contact",
    "prior": "the prior of the sensor's type, by this unit's background",
    "presses": "fitted to presses",
    "stand_in": "directions of the sensor file's lights, as a stand-in",
}
"""Where a model comes from, in words, for reports without a reason."""


def print_calibration(calibration: Calibration, candidates: bool = False) -> None:
    """Print a few lines about a calibration.

    Args:
        calibration: of the unit.
        candidates: print all models that were made, the lights and all presses, too.
    """
    report, sensor = calibration.report, calibration.sensor
    size = f"{sensor.height} x {sensor.width} px, {sensor.mm_per_pixel:g} mm per pixel, gamma {sensor.exponent:g}"
    print(f"sensor: {sensor.name}, {size}")
    kind = "point lights" if report["model"] == "point_lights" else "response field"
    reason = report.get("reason", BY[report["source"]])
    print(f"chosen: {reason}" if reason.startswith(f"{kind}:") else f"chosen: {kind}: {reason}")
    print(f"expected: {expected(calibration)}")
    if (least_known := press_next(calibration)) is not None:
        place, error_deg = least_known
        x, y = ((n - 0.5 * (size - 1)) * sensor.mm_per_pixel for n, size in zip(place, (sensor.width, sensor.height), strict=True))
        where = f"x {place[0]}, y {place[1]} px of rectified images ({x:+.1f}, {y:+.1f} mm from the middle)"
        print(f"press next: around {where}: there normals are expected to about {error_deg:.1f} degrees")
    saturated = float((calibration.background >= calibration.saturation_light).any(0).double().mean())
    if saturated > SATURATED_SHARE:
        print(f"saturated: {saturated:.0%} of the background: depth is worse there; reduce the exposure and calibrate again")
    print_doubts(report)
    for line in left_out("press", [(row["name"], row.get("reason", "")) for row in report.get("presses", []) if not row["used"]]):
        print(line)
    if candidates:
        print_tried(report)
        if calibration.lights is not None:
            print_lights(calibration.lights, report)
        if "presses" in report:
            print_presses(report["presses"])


def print_doubts(report: Report) -> None:
    """Print why not to trust a calibration, a line each; presses that were left out are named elsewhere."""
    presses = tuple(f"{row['name']}: left out" for row in report.get("presses", []) if not row["used"])
    for doubt in report.get("doubts", []):
        if not doubt.startswith(presses):
            print(doubt if doubt.startswith(NOT_CHECKED) else f"doubt: {doubt}")


def calibrated(background: Tensor, sensor: Sensor, presses: Sequence[Press], force: bool = False) -> Calibration:
    """:func:`torchvts.calibrate`; warnings become lines on stderr, save the doubts, which the summary prints."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CalibrationWarning)
        calibration = calibrate(background, sensor, presses, progress=True, force=force)
    for text in dict.fromkeys(str(warning.message) for warning in caught):
        if text not in calibration.report.get("doubts", []):
            print(f"torchvts: warning: {text}", file=sys.stderr)
    return calibration


def expected(calibration: Calibration) -> str:
    """How good depth is likely to be, from the held-out score, the record of the prior, or the spread of the lights."""
    report = calibration.report
    if not calibration.metric:
        return f"{NOT_METRIC}: see the doubts below"
    if report["model"] == "point_lights":
        spread = report.get("direction_std_deg")
        if spread is None:
            return "as good as the positions of the lights that were given; presses of a ball would measure it"
        return f"directions of the lights to {max(spread):.2f} degrees (standard deviation of the worst)"
    by_type = report.get("prior_deg") if report["source"] == "prior" else None
    degrees = f"normals within a contact to about {report.get('stated_deg', by_type or UNKNOWN_DEG):.1f} degrees"
    if report["source"] == "prior":
        how = "the mean over units that its prior was tried on" if by_type else "a guess: its prior was never tried"
        return f"{degrees}, {how}; presses of a ball would measure it on this one"
    if "stated_deg" not in report:
        return f"{degrees}, a guess; presses of a ball would measure it"
    if report.get("held_out_deg"):
        used = sum(row["used"] for row in report.get("presses", []))
        return f"{degrees} anywhere on the skin: {report['held_out_deg']:.1f} on each of {used} presses by the others"
    return f"{degrees}, by what so few presses leave open; more presses of a ball would measure it"


def left_out(what: str, rows: list[tuple[str, str]]) -> Iterator[str]:
    """A line for each of the first that were left out, and how many more there are."""
    for name, reason in rows[:SHOWN]:
        yield f"left out: {what} {name}: {reason}"
    if len(rows) > SHOWN:
        yield f"left out: {len(rows) - SHOWN} more"


def print_tried(report: Report) -> None:
    """Print a row for each model that was made."""
    rows = [[row["name"], number(row["error_deg"], 2), "; ".join(row["doubts"])] for row in report.get("tried", [])]
    print("\n" + markdown(("model", "deg", "doubts"), rows))
    print("deg: mean angle on each press by the others, or of a prior on other units; of lights the least certain direction")


def print_lights(lights: PointLights, report: Report) -> None:
    """Print where the lights are."""
    spread = [f"{v:.2f}" for v in report["direction_std_deg"]] if "direction_std_deg" in report else ["given"] * 3
    places = [[f"{v:.2f}" for v in place] for place in lights.position_mm.tolist()]
    gloss = [f"{v:.3f}" for v in lights.gloss.tolist()]
    titles = ("light", "x mm", "y mm", "z mm", "direction +- deg", "gloss")
    print("\n" + markdown(titles, [[name, *places[j], spread[j], gloss[j]] for j, name in enumerate("RGB")]))


def print_presses(presses: list[PressRow]) -> None:
    """Print a row for each press."""
    lines = []
    for press in presses:
        center = ", ".join(f"{v:.1f}" for v in press["center_px"]) if "center_px" in press else ""
        wide = 1.0 / max(press["gain"], 1e-3) if "gain" in press else None
        figures = [number(press.get("contact_radius_px"), 1), number(press.get("error_deg"), 1), number(wide, 2)]
        lines.append([press["name"], center, *figures, "" if press["used"] else f"left out: {press.get('reason', '')}"])
    print("\n" + markdown(("press", "center px", "contact radius px", "error deg", "times as wide as given", ""), lines))
    print("error, times as wide: slopes by the field of the other presses, or by the prior, compared with the ball's")
