"""The diagnosis of an image: all checks, and what is wrong in the end."""

from torch import Tensor

from ..calibration import ROUGH, channel_structure, falloff, outwardness
from ..core.checks import QUANTISATION_STD, check_field, check_range
from ..core.noise import noise_std
from ..integration import integrate_perspective
from ..model.calibration import Calibration, check_calibration
from ..model.lights import PointLights
from .camera import Spots, blockiness, levels_of, new_spots, texture_share
from .findings import SEVERITIES, Diagnosis, Finding
from .light_change import CHANNELS, FULL, SAME, Change, cell_means, compare
from .surface import (
    Reader,
    Relief,
    angle_deg,
    cast_shadow_share,
    least_spread,
    length_misfit,
    lit_noise,
    normal_noise_deg,
    peaks,
    regions,
    skirt_mm,
)
from .words import THAN_AT_CALIBRATION, in_words

USUAL_DRIFT = 0.05
"""Light of real lamps drifts, and a press scatters light over the skin: by 2 % on one GelSight Mini, by 5 % on another. What a
response field, which levels every frame, sees below this is worth no more than a note."""

NO_DRIFT = 0.01
"""Below this a smooth change of light is not worth a word."""

OF_THE_MODEL = {
    "ambient_light", "black_level", "gamma", "channels_mixed", "channels_swapped", "specular", "lights_misfit", "other_unit",
    "skin_changed", "light_changed",
}  # fmt: skip
"""What makes normals longer or shorter than one by itself: then their length says nothing more."""

FLOODED = {"skin_changed", "new_spots", "few_bits", "compressed", "other_unit", "light_changed", "noise"}
"""What may pass for contact: then its outline and number mean nothing."""

BLOCKY = 1.18
"""Steps at the borders of 8 x 8 blocks over those inside from which an image was compressed; noise alone stays below 1.1, a
JPEG of quality 95 is at 1.2 to 1.3."""

LEAST_REST = 0.15
"""Part of the image that must follow a change of light for it to be believed."""

COPLANAR = 0.3
"""Smallest singular value of the lights' directions below which they nearly lie in one plane."""

WORTH_DEG = 0.5
"""Error of normals from which a change is a warning; from six times that it is a fault."""


def diagnose(background: Tensor | None, image: Tensor, calibration: Calibration) -> Diagnosis:
    """Find what is wrong with an image or with the calibration for it: findings in words, with figures and remedies.

    Every finding is a test of a hypothesis against the noise of the images; what cannot be measured from the three inputs is not
    guessed.

    Args:
        background: (3, H, W), an image without contact of now, in [0, 1]; None if there is no such image.
        image: (3, H, W) or (1, 3, H, W) in [0, 1], the frame in question.
        calibration: of the unit that the frame is said to be from.
    Returns:
        The findings, the worst first. An image of another size is a finding, and then the only one.
    Raises:
        ValueError: not an RGB image, or values outside [0, 1] or not finite.
        TypeError: not a tensor of floats, or no calibration.
    Source:
        this project; docs/diagnose.md says what each finding means and how often it is right.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit = Calibration.from_lights(lights, Sensor("rig", 96, 128, 0.25))
        >>> print(diagnose(None, unit.background[[2, 1, 0]], unit).findings[0])
        fault: channels look swapped (red and blue): read the image in the order R, G, B [channels_swapped]
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
            return Diagnosis.of([Finding("wrong_size", message, "fault", frame.shape[2] / sensor.width)])
    found = list(run_checks(Examination(calibration, image, given)))
    if any(finding.name == "skin_changed" for finding in found):  # it says more than "light_changed"
        found = [finding for finding in found if finding.name != "light_changed"]
    return Diagnosis.of(found)


def _one_image(name: str, image: Tensor) -> Tensor:
    if isinstance(image, Tensor) and image.dim() == 4 and image.shape[0] == 1:
        image = image[0]
    check_field(name, image)
    check_range(name, image)
    return image.detach().cpu().float().clamp(0.0, 1.0)
