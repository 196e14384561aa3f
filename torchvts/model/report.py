"""The typed summary of a calibration: which model it is, where that comes from, and how far to trust it."""

from typing import Any, Literal, TypedDict, cast, get_args

from ..core.checks import brief

NOT_CHECKED = "not checked"
"""How the doubt begins that says what no image could show: it is no warning."""

COUNTS_LITTLE = 0.5
"""A press that counts less than this part of one is named with its weight."""

Model = Literal["point_lights", "response"]

Source = Literal["given", "sensor_file", "background", "prior", "presses", "stand_in"]
"""Where the model comes from: the caller, positions of lights in the sensor file, a fit of lights to the image without contact, the
response of the sensor type, presses of balls; stand_in: directions of lights whose positions do not fit, so depth is not metric."""


class Tried(TypedDict):
    """One model that calibration made.

    Attributes:
        name: what it is and comes from, in words.
        error_deg: mean error of its normals, or of its lights' directions, degrees; None where nothing measured it.
        doubts: why not to trust it, each a sentence; empty where nothing speaks against it.
    """

    name: str
    error_deg: float | None
    doubts: list[str]


class PressRow(TypedDict, total=False):
    """What became of one press. Only ``name`` and ``used`` are always there.

    Attributes:
        name: of the press.
        used: whether the fit used it.
        reason: why it was left out, or counts little, else "".
        center_px: (x, y) of the ball.
        contact_radius_px: radius of the contact.
        error_deg: mean angle between the ball's normals and those of the prior, or of the other presses, degrees.
        gain: slopes of the prior, or of the other presses, divided by the ball's slopes.
        weight: how much of a press it counts, by how far the gain is off; 0 where it was left out.
        gain_std: standard deviation of that, as far as the other presses know the place; absent where a prior is compared.
    """

    name: str
    used: bool
    reason: str
    center_px: Any  # two numbers
    contact_radius_px: float
    error_deg: float
    gain: float
    weight: float
    gain_std: float


class Report(TypedDict, total=False):
    """Summary of a calibration: a dict of plain JSON values. Only ``model`` and ``source`` are always there.

    Attributes:
        model: which model the calibration holds.
        source: where the model comes from, see :data:`Source`.
        reason: why this model was chosen.
        tried: all models that were made, the taken one last.
        doubts: all that speaks against the calibration, a sentence each with its remedy; what nothing could check comes last.
        not_metric: those of them that put the scale of depth in doubt; empty where depth is in mm.
        presses: one row per press.
        uneven: how uneven their light is, beside the background's, see :func:`torchvts.calibration.contacts.uneven_light`: another
            gamma or saturation of the camera, which changes all slopes, or another lamp.
        held_out_deg: mean error on presses by a response fitted to the other presses, degrees; None with too few presses.
        own_deg: mean error on the very presses that a response, or its prior, was fitted to, degrees.
        stated_deg: error of normals to expect anywhere on the skin, degrees: by the covariance, or the record of a prior alone.
        prior_deg: where the sensor's prior is the model, or what presses were fitted from: its mean error on presses and units that
            it was not fitted to, degrees; None where its file does not say.
        converged: whether the fit of the lights converged.
        direction_std_deg: (3,), standard deviation of each light's direction, degrees.
        misfit: (3,), size of the smooth pattern in the background that the lights cannot explain, relative to the light.
        camera_height_mm: height of a pinhole camera above the skin, where it is known.
    """

    model: Model
    source: Source
    reason: str
    tried: list[Tried]
    doubts: list[str]
    not_metric: list[str]
    presses: list[PressRow]
    uneven: float
    held_out_deg: float | None
    own_deg: float
    stated_deg: float
    prior_deg: float | None
    converged: bool
    direction_std_deg: list[float]
    misfit: list[float]
    camera_height_mm: float


def warnings_of(report: Report) -> list[str]:
    """The doubts of a calibration that are to be said with every result: all but what nothing could check."""
    return [doubt for doubt in report.get("doubts", []) if not doubt.startswith(NOT_CHECKED)]


def read_report(values: Any, source: str) -> Report:
    """Check a report; ``source`` names it in errors.

    Raises:
        ValueError: not a mapping, or ``model`` or ``source`` is missing or unknown.
    Example:
        >>> read_report({"model": "response", "source": "prior"}, "file")["source"]
        'prior'
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected keys and values, got {type(values).__name__}")
    for key, known in (("model", get_args(Model)), ("source", get_args(Source))):
        if values.get(key) not in known:
            raise ValueError(f"{source}: {key}: expected one of {', '.join(known)}, got {brief(values.get(key))}")
    return cast(Report, values)
