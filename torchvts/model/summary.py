"""What a person reads of a calibration: the model, how good it is likely to be, doubts, what was left out, what was tried."""

from collections.abc import Iterator

from ..core.tables import markdown, number
from .calibration import Calibration
from .lights import PointLights
from .report import COUNTS_LITTLE, NOT_CHECKED, PressRow, Report
from .stated_error import UNKNOWN_DEG, press_next

SHOWN = 5
"""Of a list, so many lines are shown."""

NOT_METRIC = "depth is NOT METRIC"
"""What is said of a calibration whose scale is in doubt."""

SATURATED_SHARE = 0.05
"""Share of the calibration's image that is saturated in a channel from which it is said."""


def summary_of(calibration: Calibration, tried: bool = False) -> str:
    """The lines of ``print(calibration)``; with ``tried`` also all models that were made, the lights and all presses."""
    report, sensor = calibration.report, calibration.sensor
    kind = "point lights" if report["model"] == "point_lights" else "response field"
    reason = report.get("reason", report["source"].replace("_", " "))
    size = f"{sensor.height} x {sensor.width} px, {sensor.mm_per_pixel:g} mm per pixel, gamma {sensor.exponent:g}"
    lines = [
        f"sensor: {sensor.name}, {size}",
        f"chosen: {reason}" if reason.startswith(f"{kind}:") else f"chosen: {kind}: {reason}",
        f"expected: {expected(calibration)}",
    ]
    lines += [f"press next: {where}"] if calibration.metric and (where := where_next(calibration)) else []
    saturated = float((calibration.background >= calibration.saturation_light).any(0).double().mean())
    if saturated > SATURATED_SHARE:
        lines.append(f"saturated: {saturated:.0%} of the background: depth is worse there; reduce the exposure and calibrate again")
    lines += doubts_of(report)
    lines += counts_little(report.get("presses", []))
    lines += left_out("press", [(row["name"], row.get("reason", "")) for row in report.get("presses", []) if not row["used"]])
    if tried:
        lines += ["", *_tried(report)]
        if calibration.lights is not None:
            lines += ["", _lights(calibration.lights, report)]
        if "presses" in report:
            lines += ["", *_presses(report["presses"])]
    return "\n".join(lines)


def where_next(calibration: Calibration) -> str:
    """Where a press would say most; "" where :func:`press_next` says nothing."""
    found = press_next(calibration)
    if found is None:
        return ""
    place, _ = found
    sensor = calibration.sensor
    x, y = ((n - 0.5 * (size - 1)) * sensor.mm_per_pixel for n, size in zip(place, (sensor.width, sensor.height), strict=True))
    beside = f"{abs(x):.1f} mm {'right' if x > 0 else 'left'} of the middle, {abs(y):.1f} mm {'below' if y > 0 else 'above'} it"
    return f"around x {place[0]}, y {place[1]} px of rectified images ({beside}), which is known least"


def doubts_of(report: Report) -> list[str]:
    """Why not to trust a calibration, a line each; presses that were left out are named elsewhere."""
    presses = tuple(f"{row['name']}: left out" for row in report.get("presses", []) if not row["used"])
    doubts = [doubt for doubt in report.get("doubts", []) if not doubt.startswith(presses)]
    return [doubt if doubt.startswith(NOT_CHECKED) else f"doubt: {doubt}" for doubt in doubts]


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
    stated = "stated_deg" in report
    degrees = f"normals within a contact to about {report.get('stated_deg', UNKNOWN_DEG):.1f} degrees"
    if report["source"] == "prior":
        how = "the mean over units that its prior was tried on" if stated else "a guess: its prior was never tried"
        return f"{degrees}, {how}; presses of a ball would measure it on this one"
    if not stated:
        return f"{degrees}, a guess; presses of a ball would measure it"
    if report.get("held_out_deg"):
        used = sum(row["used"] for row in report.get("presses", []))
        return f"{degrees} anywhere on the skin: {report['held_out_deg']:.1f} on each of {used} presses by the others"
    return f"{degrees}, by what so few presses leave open; more presses of a ball would measure it"


def counts_little(presses: list[PressRow]) -> Iterator[str]:
    """A line for the presses that count less than :data:`COUNTS_LITTLE`, with their weights, and are no doubt of their own."""
    rows = [row for row in presses if row["used"] and not row.get("reason") and row.get("weight", 1.0) < COUNTS_LITTLE]
    if rows:
        named = [f"{row['name']} {row['weight']:.2f}" for row in sorted(rows, key=lambda row: row["weight"])]
        more = f" and {len(named) - SHOWN} more" if len(named) > SHOWN else ""
        yield f"counts little, of 1 for a press, since its size agrees less with the others: {', '.join(named[:SHOWN])}{more}"


def left_out(what: str, rows: list[tuple[str, str]]) -> Iterator[str]:
    """A line for each of the first that were left out, and how many more there are."""
    for name, reason in rows[:SHOWN]:
        yield f"left out: {what} {name}: {reason}"
    if len(rows) > SHOWN:
        yield f"left out: {len(rows) - SHOWN} more"


def _tried(report: Report) -> list[str]:
    """A row for each model that was made, with what is not said above."""
    said = report.get("doubts", [])
    tried = [(row, "; ".join(doubt for doubt in row["doubts"] if doubt not in said)) for row in report.get("tried", [])]
    rows = [[row["name"], number(row["error_deg"], 2), beside] for row, beside in tried]
    meaning = "deg: mean angle on each press by the others, or of a prior on other units; of lights the least certain direction"
    return [markdown(("model tried", "deg", "doubts beside those above"), rows), meaning]


def _lights(lights: PointLights, report: Report) -> str:
    """Where the lights are."""
    spread = [f"{v:.2f}" for v in report["direction_std_deg"]] if "direction_std_deg" in report else ["given"] * 3
    places = [[f"{v:.2f}" for v in place] for place in lights.position_mm.tolist()]
    gloss = [f"{v:.3f}" for v in lights.gloss.tolist()]
    titles = ("light", "x mm", "y mm", "z mm", "direction +- deg", "gloss")
    return markdown(titles, [[name, *places[j], spread[j], gloss[j]] for j, name in enumerate("RGB")])


def _presses(presses: list[PressRow]) -> list[str]:
    """A row for each press."""
    rows = []
    for press in presses:
        center = ", ".join(f"{v:.1f}" for v in press["center_px"]) if "center_px" in press else ""
        wide = 1.0 / max(press["gain"], 1e-3) if "gain" in press else None
        counts = number(press.get("weight"), 2)
        figures = [number(press.get("contact_radius_px"), 1), number(press.get("error_deg"), 1), number(wide, 2), counts]
        rows.append([press["name"], center, *figures, f"{'' if press['used'] else 'left out: '}{press.get('reason', '')}"])
    titles = ("press", "center px", "contact radius px", "error deg", "times as wide as given", "counts", "")
    meaning = "error, times as wide: slopes by the field of the other presses, or by the prior, compared with the ball's"
    return [markdown(titles, rows), meaning]
