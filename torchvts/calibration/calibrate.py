"""Calibrate a unit: from what is given of it to its record."""

import dataclasses
import math
import statistics
import warnings
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from ..compensate import Compensate
from ..contact import ContactMask
from ..core.checks import check_image, check_sequence
from ..core.geometry import gradient_from_normal
from ..integration import poisson_background
from ..model.calibration import Calibration
from ..model.lights import PointLights, flat_image
from ..model.report import Report
from ..model.response_field import ResponseModel, SensorPrior, fit_log_background
from ..model.sensor import Sensor, check_sensor
from ..normals import NormalFromIntensity
from .background import falloff, outwardness
from .balls import center_by_slope, guess_circle
from .contacts import ROUGH, Contact, Press, Touch, channel_structure, depths, middle_px, read_contacts
from .field import PRODUCT_PENALTY, Family, angle_deg
from .light_candidates import choose_lights
from .lights import LOOSE_DEG, check_exposure
from .response_fit import FAMILIES, ResponseFit, fit_response, held_out_deg
from .touches import fit_touches, moved_by_touches, scale_by_presses, scaled, touch_blur_px

PINNED_DEG = 2.0
"""Point lights are believed beside a sensor's prior only if the image pins each of them this well."""

USUAL_GAIN = 1.15
"""Slopes by a prior over those of the balls are within this factor: 0.93 to 1.00 on a GelSight Mini."""

DOUBTFUL_GAIN = 1.25
"""Slopes by the field of the other presses over those of a ball are within this factor where ten presses or more agree."""

GIVEN_MISFIT = 0.2
"""RMS of log(background / what the sensor file's lights give) from which they are not this unit's."""

FOREIGN_SPREAD = 0.35
"""A background whose logarithm departs this far (RMS) from that of the prior's unit, brightness aside, is not of its type."""

RESPONSE_BLUR_PX = 1.0
"""Blur of a response field at 320 x 240: it takes a third off the error of normals on a GelSight Mini, more takes nothing."""

READING_WORTH = 0.1
"""Another gamma or blur must lower the held-out error by this part: balls are smooth, and do not show what a wider blur loses."""

PRIOR_FAMILY = ((4, 3),)
PRIOR_PRODUCT_PENALTY = 60.0
"""Free products fit their own unit better and another worse. With penalties of 40, 60 and 200 presses of a GelSight Mini that the
prior has not seen are 2.02, 2.06 and 2.24 degrees off; a bead on a second Mini is, with 40 and 60, 2.99 and 2.94 from that unit's
own network."""

TIE = 1.05
"""Point lights are preferred to response fields unless these are better by more than this."""


class CalibrationWarning(UserWarning):
    """A calibration that was made, but should not be trusted as it is."""


def calibrate(
    background: Tensor,
    sensor: Sensor,
    presses: Sequence[Press] = (),
    touches: Sequence[Touch | Tensor] = (),
    *,
    progress: bool = False,
) -> Calibration:
    """Calibrate a unit from one image without contact, and what else there is: presses of balls, touches by any object.

    The model is chosen from what is given. An image alone: the sensor's prior, carried to this unit, unless the image pins point
    lights; without a prior point lights, and a warning where they are not pinned. Presses: response fields, their size by held-out
    angle, starting from the prior if there is one; point lights if they do better on the presses. Where the balls lie is found.
    Touches: a field whose slopes have least curl; its scale from presses, a known depth, or the prior, whose place it takes if
    there is none.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: the sensor; its gamma is chosen where it is left open.
        presses: images of balls pressed anywhere; centers need not be known.
        touches: images of unknown objects, or :class:`Touch` with the depth, if that is known.
        progress: show a bar.
    Returns:
        A :class:`Calibration`. Its ``report`` holds "model", "reason", "candidates" (each with the figure that decided), and
        "presses": per press "name", "used", "reason", "center_px" (x, y), "contact_radius_px", "error_deg".
    Raises:
        ValueError, TypeError: bad image: shape, dtype, range, black, saturated; presses or touches of which none can be used;
            touches that pin nothing, or whose scale nothing tells.
    Warns:
        CalibrationWarning: what was left out and why; the fit did not converge, the image does not pin the lights, it seems to
            hold a contact, or it is not of the prior's sensor type.
    Source:
        eq. 6-8 of the paper for lights; the rest is this project's.
    Example:
        >>> sensor = Sensor(name="rig", height=48, width=64, mm_per_pixel=0.6)
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate(flat_image(lights, 48, 64, 0.6).detach(), sensor).report["model"]
        'point_lights'
    """
    check_sensor("sensor", sensor)
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_exposure(background)
    presses, touches = _named_presses(presses, sensor), _named_touches(touches, sensor)
    by_lights, light_rows, complaint = _by_lights(background, sensor, bool(presses or touches or sensor.prior), progress)
    lights_row, candidates = light_rows[0], list(light_rows)
    prior = None if sensor.prior is None else sensor.prior.response
    if prior is not None and sensor.blur_px > 0:
        prior = dataclasses.replace(prior, blur_px=sensor.blur_px)
    if prior is not None:
        _check_type(background, sensor)
        structure = channel_structure(background)
        if structure > ROUGH and not sensor.markers:
            warnings.warn(
                f"background: structure between the channels of {structure:.2f}, a skin at rest stays below {ROUGH}: contact in "
                "the calibration image? take it again without",
                CalibrationWarning,
                stacklevel=2,
            )
    touched = None
    if touches:
        try:
            prior, touched = _by_touches(background, sensor, presses, touches, prior)
            candidates.append(touched["row"])
        except ValueError as error:
            if not presses:
                raise
            warnings.warn(f"{error}; going on with the presses alone", CalibrationWarning, stacklevel=2)
    if not presses:
        pinned = lights_row["score_deg"] <= PINNED_DEG and lights_row["misfit"] < 0.02
        if prior is None or (pinned and touched is None):
            if complaint:
                warnings.warn(complaint, CalibrationWarning, stacklevel=2)
            pins = pinned and lights_row["score_deg"] > 0.0
            reason = f"the image pins the lights to {lights_row['score_deg']:.2f} deg" if pins else lights_row["note"]
            if len(light_rows) > 1:
                reason += f"; {by_lights.report['chosen_because']}"
            report: Any = by_lights.report | {"reason": f"point lights: {reason}", "candidates": candidates}
            return _judge_rest(dataclasses.replace(by_lights, report=report))
        if touched is not None:
            reason = f"{touched['row']['note']}; point lights rejected: {lights_row['note']}"
            report = {"model": "response", "source": "touches", "reason": reason, "candidates": candidates}
            return Calibration.from_response(prior, sensor, background, {**report, "touches": touched["touches"]})
        candidates.append(
            {"model": "prior", "family": "response of the sensor type", "parameters": 0, "score_deg": None, "passes": 2}
        )
        reason = f"the sensor's prior, carried to this unit by its background; point lights rejected: {lights_row['note']}"
        report = {"model": "response", "source": "prior", "reason": reason, "candidates": candidates}
        return Calibration.from_response(prior, sensor, background, report)
    fit, contacts, by_response = by_presses(background, sensor, presses, prior, progress)
    candidates += fit.candidates
    used = [contact for contact in contacts if not contact.reason]
    lights_row["score_deg"] = lights_error = _lights_error(by_lights, presses, contacts, by_response.sensor.blur_px)
    _warn_left_out(contacts)
    if prior is not None:
        _warn_of_diameters(used)
    else:
        _warn_of_doubt(used)
    told: dict[str, Any] = {} if touched is None else {"touches": touched["touches"]}
    told |= {"candidates": candidates, "presses": [_tell(contact, sensor) for contact in contacts]}
    # twelve numbers that do about as well as a hundred are the better model
    if lights_error < (math.inf if fit.error_deg is None else TIE * fit.error_deg) and lights_error < LOOSE_DEG:
        other = "too few presses for a response field" if fit.error_deg is None else f"response fields {fit.error_deg:.2f}"
        reason = f"point lights: on {len(used)} presses their normals are {lights_error:.2f} deg off, {other}"
        return _judge_rest(dataclasses.replace(by_lights, report=cast(Report, by_lights.report | {"reason": reason} | told)))
    lights_row["note"] = f"rejected: on {len(used)} presses their normals are {lights_error:.1f} deg off; {lights_row['note']}"
    report = {"model": "response", "source": "presses", "reason": fit.reason, "held_out_deg": fit.error_deg} | told
    return dataclasses.replace(by_response, report=report)


def fit_prior(background: Tensor, sensor: Sensor, presses: Sequence[Press], source: str = "") -> SensorPrior:
    """What presses on one unit say of every unit of its type: a field of a size that carries over to other units.

    Linear terms of degree 4 and products of degree 3, the latter dear: free ones fit this unit better and others worse.

    Args:
        background, sensor, presses: as for :func:`calibrate`; a prior of the sensor is not looked at.
        source: whose images these are, kept with the prior.
    Raises:
        ValueError, TypeError: as :func:`calibrate`.
    Source:
        this project.
    """
    check_sensor("sensor", sensor)
    if not isinstance(source, str):
        raise TypeError(f"source: expected a text, got {type(source).__name__}")
    check_sequence("presses", presses, "Press")
    if len(presses) == 0:
        raise ValueError("presses: expected one or more, got none: a prior is what presses say")
    bare = sensor.without_prior()
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    fit, contacts, unit = by_presses(
        background, bare, _named_presses(presses, sensor), None, False, PRIOR_FAMILY, PRIOR_PRODUCT_PENALTY
    )
    _warn_left_out(contacts)
    log_background = fit_log_background(unit.background, sensor.mm_per_pixel)
    return SensorPrior(fit.model, log_background, 0.5 * sensor.width * sensor.mm_per_pixel, source)


def _by_lights(
    background: Tensor, sensor: Sensor, other_models: bool, progress: bool
) -> tuple[Calibration, list[dict[str, Any]], str]:
    """Point lights from the image, their rows in the table of candidates, chosen one first, and what there is to complain of."""
    report: dict[str, Any] = {"model": "point_lights", "source": "background"}
    if sensor.light_position_mm is not None:
        lights = _scale_albedo(PointLights([list(row) for row in sensor.light_position_mm], [1.0, 1.0, 1.0]), background, sensor)
        family = "three lights at known positions"
        report |= {"source": "sensor_file", "converged": True, "family": family}
        given = Calibration.from_lights(lights, sensor, background, report)
        cell = max(1, min(sensor.height, sensor.width) // 30)
        log = [torch.nn.functional.avg_pool2d(i[None], cell).clamp_min(1e-3).log() for i in (given.background, given.model_image)]
        misfit = float((log[0] - log[1]).std(dim=(2, 3)).max())
        row: dict[str, Any] = {"model": "point lights", "family": family, "parameters": 3, "passes": 2, "misfit": misfit}
        note = f"given by the sensor file; the background departs from them by {misfit:.1%} (RMS)"
        complaint = "" if misfit < GIVEN_MISFIT else f"background: lights {note}: not this unit's lights, and depth is not metric"
        return given, [row | {"score_deg": 0.0, "note": note}], complaint
    choice = choose_lights(background, sensor, other_models, progress)
    fit, row = choice.fit, choice.rows[0]
    report |= {
        "family": row["family"],
        "chosen_because": choice.reason,
        "converged": fit.converged,
        "message": fit.message,
        "steps": len(fit.loss_history),
        "loss": fit.loss_history[-1],
        "gamma": choice.sensor.exponent,
        "direction_std_deg": fit.direction_std_deg.tolist(),
        "position_std_mm": fit.position_std_mm.tolist(),
        "misfit": fit.misfit.tolist(),
        "inlier_fraction": fit.inlier_fraction,
        "gloss": fit.lights.gloss.tolist(),
        "vignetting": fit.vignetting,
        "ambient": fit.ambient.tolist(),
    }
    ambient = fit.ambient.clamp_min(0.0) if bool((fit.ambient > 0).any()) else None
    return Calibration.from_lights(fit.lights, choice.sensor, background, report, ambient), choice.rows, choice.complaint


def by_presses(
    background: Tensor,
    sensor: Sensor,
    presses: Sequence[Press],
    prior: ResponseModel | None,
    progress: bool,
    families: tuple[tuple[int, int], ...] = FAMILIES,
    product_penalty: float = PRODUCT_PENALTY,
) -> tuple[ResponseFit, list[Contact], Calibration]:
    """A response model from presses: the fit, what became of each press, and the unit."""
    chosen = as_read(sensor, prior)
    contacts = _contacts(background, chosen, presses)
    light = _unit_at_rest(background, chosen).background
    fit = fit_response(contacts, light, chosen, prior, progress, families, product_penalty)
    if prior is None and fit.error_deg is not None:
        open_to = (sensor.gamma is None, sensor.blur_px == 0)
        fit, chosen = _choose_reading(background, chosen, *open_to, presses, contacts, fit, families, product_penalty)
    return fit, contacts, Calibration.from_response(fit.model, chosen, background)


def as_read(sensor: Sensor, prior: ResponseModel | None) -> Sensor:
    """The sensor with the gamma and blur that images are read with: the prior's, or usual ones to start with."""
    if prior is not None:
        return dataclasses.replace(sensor, gamma=prior.gamma, blur_px=prior.blur_px)
    usual_px = RESPONSE_BLUR_PX * max(1.0, min(sensor.height, sensor.width) / 240)
    return dataclasses.replace(sensor, gamma=sensor.exponent, blur_px=max(sensor.blur_px, usual_px))


def _choose_reading(
    background: Tensor,
    sensor: Sensor,
    gamma_open: bool,
    blur_open: bool,
    presses: Sequence[Press],
    contacts: Sequence[Contact],
    fit: ResponseFit,
    families: tuple[tuple[int, int], ...],
    product_penalty: float,
) -> tuple[ResponseFit, Sensor]:
    """Whether another gamma or blur makes the first pass of the same family clearly better on held-out presses; if so, that fit.

    The balls stay where they were found: a reading changes a center by less than it was uncertain.
    """
    used = [(press, contact) for press, contact in zip(presses, contacts) if not contact.reason]
    located = [_located(press, contact, sensor) for press, contact in used]
    readings = [(sensor.exponent, factor * sensor.blur_px) for factor in (0.5, 2.0) if blur_open]
    readings += [(2.2, sensor.blur_px)] if gamma_open else []
    least, taken = (1.0 - READING_WORTH) * held_out_deg([contact for _, contact in used], fit.model.fast), None
    for gamma, blur_px in readings:
        other = dataclasses.replace(sensor, gamma=gamma, blur_px=blur_px)
        read = _contacts(background, other, located)
        score = held_out_deg(read, fit.model.fast)
        label = f"response, read with gamma {gamma:g} and a blur of {blur_px:g} px"
        family, numbers = Family.of(fit.model.fast).label(), 2 * fit.model.fast.size()
        fit.candidates.append({"model": label, "family": family, "parameters": numbers, "score_deg": score, "passes": 1})
        if score < least:
            least, taken = score, (other, read)
    if taken is None:
        return fit, sensor
    light = _unit_at_rest(background, taken[0]).background
    again = fit_response(taken[1], light, taken[0], None, False, families, product_penalty)
    again.candidates = fit.candidates + again.candidates
    return again, taken[0]


def _unit_at_rest(background: Tensor, sensor: Sensor) -> Calibration:
    """The unit before anything is known of its response: its background in linear light, blurred and cleaned as frames are."""
    return Calibration.from_response(ResponseModel.blank(sensor.exponent, sensor.blur_px), sensor, background.double())


def _contacts(background: Tensor, sensor: Sensor, given: Sequence[Press | Touch]) -> list[Contact]:
    """Contacts as the pipeline would see them."""
    unit = _unit_at_rest(background, sensor)
    compensate, contact = Compensate.from_calibration(unit).double(), ContactMask.from_calibration(unit).double()
    return read_contacts(given, background, compensate, contact, sensor)


def _by_touches(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], touches: Sequence[Touch], prior: ResponseModel | None
) -> tuple[ResponseModel, dict[str, Any]]:
    """A model from touches, scaled; and what to tell of it."""
    pitch = sensor.mm_per_pixel
    sharp = as_read(sensor, prior)
    seen = dataclasses.replace(sharp, blur_px=touch_blur_px(sensor.height, sensor.width))
    contacts = _contacts(background, seen, touches)
    _warn_left_out(contacts)
    told = [{"name": contact.name, "used": not contact.reason, "reason": contact.reason} for contact in contacts]
    used = [contact for contact in contacts if not contact.reason]
    if not used:
        raise ValueError("touches: none can be used: " + "; ".join(f"{c.name}: {c.reason}" for c in contacts))
    row: dict[str, Any] = {"model": "touches", "score_deg": None, "passes": 1}
    if prior is not None:
        row |= {
            "family": "the prior, moved",
            "parameters": 2 * prior.fast.size(),
            "note": f"the prior, moved by {len(used)} touches",
        }
        return moved_by_touches(prior, used), {"row": row, "touches": told}
    fit = fit_touches(used, _unit_at_rest(background, seen).background, 0.5 * sensor.width * pitch, pitch)
    told_depth = [(touch.depth_mm, c) for touch, c in zip(touches, contacts) if touch.depth_mm is not None and not c.reason]
    balls = [contact for contact in _contacts(background, sharp, presses) if not contact.reason]
    for ball in balls:
        if not ball.known:
            guess_circle(ball, sharp)
    balls = [ball for ball in balls if not ball.reason]
    if balls:
        scale, by = scale_by_presses(fit.field, balls, pitch), f"{len(balls)} presses"
    elif told_depth:
        deepest = [float(depth.max()) for depth in depths([contact for _, contact in told_depth], fit.field, pitch)]
        ratios = [known / max(found, 1e-9) for (known, _), found in zip(told_depth, deepest)]
        scale, by = statistics.median(ratios), f"{len(ratios)} known depths"
    else:
        raise ValueError(
            "touches: expected something that tells their scale, got only touches: add a press of a ball of known diameter, "
            "Touch(image, depth_mm), or a sensor with a prior"
        )
    if not scale > 0:
        raise ValueError(f"touches: the scale by {by} came out as {scale:.3g}: the presses are no clean balls, or not of this unit")
    numbers = fit.pinned.size()
    note = f"{len(used)} touches pin {numbers} numbers (eigenvalue gap {fit.gap:.1f}), the scale by {by}"
    row |= {"family": fit.pinned.label(), "parameters": numbers, "note": note, "tried": fit.tried}
    field = scaled(fit.field, scale)
    precise = field.lifted(field.degree, field.product_degree, True)  # touches tell nothing of depth
    return ResponseModel(field, precise, sharp.exponent, sharp.blur_px), {"row": row, "touches": told}


def _named_presses(presses: Sequence[Press], sensor: Sensor) -> list[Press]:
    """The presses, each with a name; checked."""
    check_sequence("presses", presses, "Press")
    named = []
    for k, press in enumerate(presses):
        if not isinstance(press, Press):
            raise TypeError(f"presses[{k}]: expected a Press, got {type(press).__name__}: Press(image, ball_diameter_mm)")
        named.append(press if press.name else dataclasses.replace(press, name=f"presses[{k}]"))
        check_image(f"{named[k].name}: image", press.image, sensor.height, sensor.width, sensor.name)
    return named


def _named_touches(touches: Sequence[Touch | Tensor], sensor: Sensor) -> list[Touch]:
    """The touches, each with a name; checked."""
    check_sequence("touches", touches, "images or Touch")
    named = []
    for k, given in enumerate(touches):
        touch = given if isinstance(given, Touch) else Touch(given)
        named.append(touch if touch.name else dataclasses.replace(touch, name=f"touches[{k}]"))
        check_image(f"{named[k].name}: image", touch.image, sensor.height, sensor.width, sensor.name)
    return named


def _warn_left_out(contacts: Sequence[Contact]) -> None:
    for contact in contacts:
        if contact.reason:
            warnings.warn(f"{contact.name}: left out: {contact.reason}", CalibrationWarning, stacklevel=4)


def _warn_of_diameters(contacts: Sequence[Contact]) -> None:
    """The prior's slopes on the balls, over the balls' own: one diameter wrong is found by the others, all wrong only so."""
    gain = statistics.median(contact.figures["gain"] for contact in contacts)
    if abs(math.log(max(gain, 1e-3))) > math.log(USUAL_GAIN):
        warnings.warn(
            f"presses: by the sensor's prior the balls seem {1.0 / gain:.2f} times as wide as was said: wrong diameter or pitch? "
            "if they are right, this unit differs from the prior's, and more presses tell",
            CalibrationWarning,
            stacklevel=3,
        )


def _warn_of_doubt(contacts: Sequence[Contact]) -> None:
    """Diameters that the other presses neither contradict nor bear out: fields of few presses are too rough to tell."""
    doubtful = [c for c in contacts if abs(math.log(max(c.figures.get("gain", 1.0), 1e-3))) > math.log(DOUBTFUL_GAIN)]
    if doubtful:
        named = ", ".join(f"{c.name} ({1.0 / c.figures['gain']:.2f})" for c in doubtful)
        warnings.warn(
            f"presses: by the others the balls of {named} seem so many times as wide as was said: a wrong diameter, or a skin that "
            "differs from place to place; more presses tell",
            CalibrationWarning,
            stacklevel=3,
        )


def _located(press: Press, contact: Contact, sensor: Sensor) -> Press:
    """The press with the ball where it was found."""
    x, y = (contact.center_mm / sensor.mm_per_pixel + middle_px(sensor)).tolist()
    return dataclasses.replace(press, center_px=(x, y), contact_radius_px=contact.contact_radius_mm / sensor.mm_per_pixel)


def _lights_error(calibration: Calibration, presses: Sequence[Press], contacts: Sequence[Contact], blur_px: float) -> float:
    """Mean angle of the point lights' normals on the balls that were found, by their second pass and blurred alike, degrees.

    A ball lies where the lights' own slopes put it: a wrong field takes an error of the centers into itself, lights cannot.
    """
    blurred = dataclasses.replace(calibration, sensor=dataclasses.replace(calibration.sensor, blur_px=blur_px))
    pitch = calibration.sensor.mm_per_pixel
    compensate = Compensate.from_calibration(blurred)
    normals = NormalFromIntensity.from_calibration(blurred)
    errors = []
    for press, contact in zip(presses, contacts):
        if contact.reason:
            continue
        image = compensate(press.image.detach().cpu().to(calibration.background.dtype)[None])
        depth = poisson_background(gradient_from_normal(normals(image)) * contact.mask, pitch)
        slope = gradient_from_normal(normals(image, depth))[0].double()
        own = dataclasses.replace(contact)
        if not own.known:
            center_by_slope(own, slope, pitch)
        if own.reason:
            own = contact
        inside = own.inside()
        errors.append(angle_deg(slope.flatten(1)[:, own.index][:, inside], own.ball_slope()[:, inside]))
    return sum(errors) / len(errors)


def _tell(contact: Contact, sensor: Sensor) -> dict[str, Any]:
    """A press's line in the report."""
    told = {"name": contact.name, "used": not contact.reason, "reason": contact.reason} | contact.figures
    if contact.contact_radius_mm > 0:
        told["center_px"] = (contact.center_mm / sensor.mm_per_pixel + middle_px(sensor)).tolist()
        told["contact_radius_px"] = contact.contact_radius_mm / sensor.mm_per_pixel
    return told


def _check_type(background: Tensor, sensor: Sensor) -> None:
    """Warn if the background is not one that units of this type show."""
    assert sensor.prior is not None
    gamma = sensor.prior.response.gamma
    usual = sensor.prior.background(sensor.height, sensor.width, sensor.mm_per_pixel).log()
    ratio = gamma * background.double().clamp_min(1e-3).log() - usual
    spread = float((ratio - ratio.mean()).square().mean().sqrt())
    if spread > FOREIGN_SPREAD:
        warnings.warn(
            f"background: its light is spread {spread:.0%} (RMS) unlike that of the unit the prior of sensor '{sensor.name}' was "
            f"fitted on, at most {FOREIGN_SPREAD:.0%} is usual: another sensor type, channels swapped, or a lamp out",
            CalibrationWarning,
            stacklevel=3,
        )


def _judge_rest(calibration: Calibration) -> Calibration:
    """Add how far the background is from the lights' model, and warn if it seems to hold a contact."""
    model, report = calibration.model_image, calibration.report.copy()
    if "vignetting" in report:  # the camera's, which the gain takes out
        model = model * falloff(outwardness(calibration.sensor), report["vignetting"]).to(model.dtype)
    if calibration.ambient is not None:
        model = model + calibration.ambient.reshape(3, 1, 1)
    spread = (model - calibration.background).abs().flatten(1).median(dim=1).values / 0.6745
    report["residual_std"] = spread.tolist()
    # contact changes the light by more than 5 % and is wider than dirt: 5 sigmas of the residual and of 1 % of the model
    judge = ContactMask(model, spread.reshape(3, 1, 1) + 0.01 * model, min_size_px=0.05 * calibration.sensor.height)
    full = (calibration.background > 0.995) | (model > 0.95)  # what the camera clips tells nothing
    seen = torch.where(full, model, calibration.background)
    standing_out = float(judge(seen[None]).double().mean())
    report["standing_out"] = standing_out
    if standing_out > 0.01:
        warnings.warn(
            f"background: {standing_out:.1%} of the image stands out from the fitted lights by more than 5 times their residual "
            f"({', '.join(f'{v:.4f}' for v in spread.tolist())}): contact in the calibration image? take it again without",
            CalibrationWarning,
            stacklevel=3,
        )
    return dataclasses.replace(calibration, report=report)


def _scale_albedo(lights: PointLights, background: Tensor, sensor: Sensor) -> PointLights:
    """The albedo that makes the median of image / model one in each channel."""
    model = flat_image(lights, sensor.height, sensor.width, sensor.mm_per_pixel).detach()
    ratio = (background.to(model.dtype) ** sensor.exponent / model).flatten(1).median(dim=1).values
    return PointLights(lights.position_mm.detach(), torch.clamp_min(ratio, 1e-6))
