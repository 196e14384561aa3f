"""The diagnosis of an image: all checks, and what is wrong in the end."""

from torch import Tensor

from ..core.checks import check_field, check_range, check_tensor
from ..model import Calibration, check_calibration
from .checks import run_checks
from .examination import Examination
from .findings import Diagnosis, Finding


def diagnose(background: Tensor | None, image: Tensor, calibration: Calibration) -> Diagnosis:
    """Find what is wrong with an image or with the calibration for it: findings in words, with figures and remedies.

    The frame is read by the pipeline of the calibration, and findings say what is wrong with that reading; what cannot be measured
    from the three inputs is not guessed. The first fault of the frame itself ends the search: it makes all else meaningless.
    docs/diagnose.md says what each finding means.

    Args:
        background: (3, H, W), an image without contact of now, in [0, 1]; None if there is no such image.
        image: (3, H, W) or (1, 3, H, W) in [0, 1], the frame in question.
        calibration: of the unit that the frame is said to be from.
    Returns:
        The findings, the worst first. An image of another size is a finding, and then the only one.
    Raises:
        ValueError: not an RGB image, or values outside [0, 1] or not finite.
        TypeError: not a tensor of floats, or no calibration.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit = Calibration.from_lights(lights, Sensor("rig", 96, 128, 0.25))
        >>> diagnose(None, unit.background[[2, 1, 0]], unit).names
        ('channels_swapped',)
    """
    check_calibration("calibration", calibration)
    image = _one_image("image", image)
    given = None if background is None else _one_image("background", background)
    sensor = calibration.sensor
    for name, frame in (("image", image), ("background", given)):
        if frame is not None and tuple(frame.shape[1:]) != (sensor.height, sensor.width):
            message = (
                f"{name} is {frame.shape[1]} x {frame.shape[2]} pixels, the calibration is for {sensor.height} x {sensor.width}: "
                "another camera mode or sensor; rectify or resize it as at calibration"
            )
            return Diagnosis.of([Finding("wrong_size", message, "fault", 1.0)])
    return Diagnosis.of(run_checks(Examination(calibration, image, given)))


def _one_image(name: str, image: Tensor) -> Tensor:
    check_tensor(name, image)
    if image.dim() == 4 and image.shape[0] == 1:
        image = image[0]
    check_field(name, image)
    check_range(name, image)
    return image.detach().cpu().float().clamp(0.0, 1.0)
