"""Calibrate a unit from the images that are there."""

import warnings
from collections.abc import Sequence

from torch import Tensor

from ..core.checks import check_image, check_switch
from ..core.threads import one_thread
from ..model.calibration import Calibration
from ..model.report import warnings_of
from ..model.sensor import Sensor, check_sensor
from .choose import Given, choose
from .doubts import CalibrationWarning
from .given_images import check_exposure, check_light, sort_presses
from .presses import Press, check_presses


def calibrate(
    background: Tensor,
    sensor: Sensor,
    presses: Sequence[Press] = (),
    *,
    progress: bool = False,
    force: bool = False,
) -> Calibration:
    """Calibrate a unit from one image without contact and, better, presses of balls.

    A model is either three point lights or a response field (docs/conventions.md). Which one depends on what is given:

    * Presses: a response field, the most likely one by the prior of the sensor's type, or of all sensors, and the presses. The
      balls are located automatically.
    * An image alone, of a sensor with a prior: the response field of its type, applied to this unit's background.
    * An image alone: point lights, and a warning where they are poorly constrained. Of lights that the sensor file gives and that
      do not look like the image only the directions are used, with a warning: depth is then not metric. To try them where there
      is a prior, give ``sensor.without_prior()``.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: the sensor.
        presses: images of balls pressed anywhere; centers need not be known.
        progress: show a bar.
        force: go on where contacts are wider than their balls; that is then a warning.
    Returns:
        A :class:`Calibration`. Its ``report`` (:class:`torchvts.model.report.Report`) says which model it is and why, all doubts,
        and what became of each press.
    Raises:
        ValueError, TypeError: bad image: shape, dtype, range, black, saturated, greyscale; a sensor without coloured lights;
            presses of which none can be used; presses that are turned, mirrored, cropped or swapped otherwise than the
            background, of another unit, or 12 bits stored in 16; contacts wider than their balls; nothing but lights to calibrate
            from, and their fit failed.
    Warns:
        CalibrationWarning: each doubt: what was left out and why; the fit did not converge, the image does not constrain the
            lights, it seems to hold a contact, or it does not have the pattern of light of the prior's sensor type, and presses
            decide whether the prior is used; sizes that the prior or the presses contradict. What nothing could check is a doubt
            without a warning.
    Source:
        eq. 6-8 of the paper for lights.
    Example:
        >>> from torchvts.model.lights import PointLights, flat_image
        >>> sensor = Sensor(name="rig", height=48, width=64, mm_per_pixel=0.6)
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate(flat_image(lights, 48, 64, 0.6).detach(), sensor).report["model"]
        'point_lights'
    """
    check_sensor("sensor", sensor)
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_exposure(background)
    check_switch("progress", progress)
    check_switch("force", force)
    named = check_presses(presses, sensor)
    kept, left_out = sort_presses(background, named)
    check_light(background, kept)
    with one_thread(background[0].numel()):
        calibration = choose(Given(background, sensor, kept, progress, force))
    report = calibration.report
    for k, reason in left_out:
        report["presses"].insert(k, {"name": named[k].name, "used": False, "reason": reason, "weight": 0.0})
    report["doubts"] = [f"{named[k].name}: left out: {reason}" for k, reason in left_out] + report["doubts"]
    for doubt in warnings_of(report):
        warnings.warn(doubt, CalibrationWarning, stacklevel=2)
    return calibration
