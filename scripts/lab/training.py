"""Presses to learn from, without their labels, and the calibration that they give."""

from collections.abc import Sequence
from functools import cached_property

from torch import Tensor

from torchvts.calibration import Press
from torchvts.calibration.presses import check_presses
from torchvts.model import Calibration, Sensor
from torchvts.training.presses import found_by, quiet_calibrate, without_labels


class Training:
    """Presses to learn from, without their labels, and the calibration that they give.

    Args:
        background: (3, H, W) in [0, 1], image without contact.
        presses: presses to learn from.
        sensor: the sensor; its prior is used if it has one.
    """

    def __init__(self, background: Tensor, presses: Sequence[Press], sensor: Sensor) -> None:
        self.background, self.sensor = background, sensor
        self.presses = [without_labels(press) for press in check_presses(presses, sensor)]

    @cached_property
    def _attempt(self) -> Calibration | Exception:
        try:
            return quiet_calibrate(self.background, self.sensor, self.presses)
        except Exception as error:  # kept, because every method that asks would wait for it again
            return error

    @property
    def calibration(self) -> Calibration:
        """Calibration by all presses, made when first needed."""
        if isinstance(self._attempt, Exception):
            raise self._attempt
        return self._attempt

    @cached_property
    def without_prior(self) -> "Training":
        """The same presses, and a sensor without a prior."""
        return self if self.sensor.prior is None else Training(self.background, self.presses, self.sensor.without_prior())

    @cached_property
    def found(self) -> list[Press | None]:
        """The presses with the centres and contact radii that the calibration found; None where it left one out."""
        if not self.presses:
            raise ValueError("presses: expected at least one to learn from, got none")
        return found_by(self.calibration, self.presses)

    @property
    def located(self) -> list[Press]:
        """The presses that the calibration used, with the centres and contact radii that it found."""
        return [press for press in self.found if press is not None]


def with_centers(background: Tensor, sensor: Sensor, presses: Sequence[Press]) -> list[Press]:
    """The presses with centre and contact radius; where there is no centre, ``calibrate`` locates the balls."""
    named = check_presses(presses, sensor)
    bare = [k for k, press in enumerate(named) if press.center_px is None]
    found = dict(zip(bare, Training(background, [named[k] for k in bare], sensor).found)) if bare else {}
    known = [found.get(k, press) for k, press in enumerate(named)]
    return [press for press in known if press is not None and press.contact_radius_px is not None]
