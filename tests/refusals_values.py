"""Entries of the tables of refusals, and the values, good and bad, that several of them share."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts.model.response_field import DepthBrightness, ResponseModel

HEIGHT, WIDTH, PITCH = 24, 32, 1.25
NAN, INF = float("nan"), float("inf")


def lights():
    return ring_lights(31.0, 40.0)


def sensor():
    return vts.Sensor("rig", HEIGHT, WIDTH, PITCH)


def scene():
    return vts.scenes.sphere_press(10.0, 1.0, (0, 0), HEIGHT, WIDTH, PITCH)


def image():
    return vts.scenes.render(vts.scenes.undeformed(scene()), lights())[0]


def fields():
    family = vts.calibration.field.Family(0, -1, 20.0)
    return family.field(torch.linspace(-0.2, 0.3, 2 * family.size(), dtype=torch.float64).reshape(2, -1))


def by_depth():
    return DepthBrightness(0, 20.0, ((0.05,), (-0.02,), (0.1,)))


def unit(by="lights"):
    if by == "lights":
        return vts.Calibration.from_lights(lights(), sensor(), image())
    return vts.Calibration.from_response(ResponseModel(fields(), by_depth()), sensor(), image())


def pipe(mode="fast"):
    return vts.DepthPipeline.from_calibration(unit(), mode)


def lookup():
    slope = torch.randn(100, 2, generator=torch.Generator().manual_seed(1))
    return vts.NormalFromLookup.fit(image(), slope @ torch.ones(2, 3) * 0.1, slope, bins=4)


def network():
    return vts.NormalFromMLP(HEIGHT, WIDTH, image())


def frame():
    """A deep press with enough pixels for a pose."""
    return vts.scenes.sphere_press(10.0, 2.0, (0, 0), 60, 80, 0.4)


def cloud():
    return torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


# values that a kind of argument does not take
NUMBER = ["1", None, True, NAN, INF, 0, -1.0, [1.0]]
INTEGER = ["8", None, True, 8.5, 0, -3]
SENSOR = ["gelsight_mini", None, Path("rig.yaml")]
MISSING = [Path("no/such/file.safetensors")]
OTHERS = ["unit.safetensors", None, 3]


def batches(channels, height=HEIGHT, width=WIDTH):
    """Values that are no (B, channels, H, W) batch of floats."""
    good = torch.full((2, channels, height, width), 0.5)
    return [
        good[0], good[:, :0], torch.cat((good, good), 1), good.permute(0, 2, 3, 1), good.to(torch.uint8), good.bool(),
        good.numpy(), (255 * good[0].permute(1, 2, 0)).numpy().astype(np.uint8), good.tolist(), None, "image.png",
    ]  # fmt: skip


def images(height=HEIGHT, width=WIDTH):
    """Values that are no (3, H, W) image in [0, 1]."""
    good = torch.full((3, height, width), 0.5)
    return [
        good[None], good[:1], good[0], good[:, :0], good[:, :-1], good.permute(1, 2, 0), (255 * good).to(torch.uint8),
        255 * good, good - 1.0, good + NAN, good + INF, good.numpy(), (255 * good).permute(1, 2, 0).numpy().astype(np.uint8),
        None, "image.png",
    ]  # fmt: skip


def of_other_size(frame):
    """Whether it is a valid image of a size that diagnose accepts: another size is a finding."""
    return isinstance(frame, torch.Tensor) and tuple(frame.shape) in {(1, 3, HEIGHT, WIDTH), (3, HEIGHT - 1, WIDTH)}


PRESS = vts.Press(torch.full((3, HEIGHT, WIDTH), 0.5), 6.0)


@dataclass
class Entry:
    """A call that is accepted, and for each argument what is refused; ``call`` makes the callable, its own name if None."""

    good: dict[str, Any]
    bad: dict[str, list[Any]]
    call: Any = None
    named: dict[str, str] = field(default_factory=dict)  # arguments that messages call by another name
    label: tuple[str, ...] = ()  # arguments that are not used, or only name things in messages
    file: tuple[str, ...] = ()  # arguments that are files
    run: bool = True  # whether the accepted call is made: not where it would open a camera or take minutes

    def __post_init__(self):
        usual = {name: COMMON[name] for name in self.good if name in COMMON and name not in (*self.bad, *self.label)}
        self.bad = {**self.bad, **usual}


def forward(make, channels, argument, label=()):
    return Entry({argument: torch.full((1, channels, HEIGHT, WIDTH), 0.5)}, {argument: batches(channels)}, make, label=label)


HEIGHTS = ["1", None, True, NAN, 0, -1.0, [1.0]]  # of a camera; infinite is one
SIZE = {"height": HEIGHT, "width": WIDTH, "mm_per_pixel": PITCH}
CENTER = [(1.0,), None, "00", (0.0, NAN), 3.0]
DEPTH = torch.zeros(1, 1, HEIGHT, WIDTH)
BAD_DEPTH = [torch.zeros(2, 1, 8, 8), torch.zeros(4), np.zeros((8, 8)), None, [[0.0]], torch.zeros(8, 8, dtype=torch.int64)]
MAP = np.zeros((4, 4))
BAD_MAP = [np.zeros((1, 4, 4)), np.zeros((4, 4), np.uint8), None, "map.npy", [[0.0]]]
FLAT = torch.full((3, HEIGHT, WIDTH), 0.5)
BAD_FLAT = [FLAT[None], FLAT[0], FLAT.permute(1, 2, 0), (255 * FLAT).to(torch.uint8), FLAT + NAN, FLAT.numpy(), None]
POSITION = [[20.0, 0.0, 30.0], [-10.0, 17.0, 30.0], [-10.0, -17.0, 30.0]]
BAD_POSITION = [[[0, 0, 1]], "lights", None, [[20.0, 0.0, -30.0]] * 3, [[20.0, 0.0, NAN]] * 3]
BAD_POINTS = [torch.zeros(50), torch.zeros(50, 2), torch.zeros(0, 3), torch.zeros(50, 3), cloud() + NAN, cloud().numpy(), None]
EYE = torch.eye(4, dtype=torch.float64)
BAD_POSE = [EYE[:3], 2 * EYE, EYE + NAN, np.eye(4), "pose"]

UP = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
OUT = vts.DepthOutput(DEPTH, torch.zeros(1, 2, HEIGHT, WIDTH), UP, DEPTH > 0, DEPTH > 0)
GRADIENT = torch.zeros(1, 2, 8, 8)
BAD_GRADIENT = [*batches(2), torch.zeros(1, 2, 1, 8)]
COMMON = {"height": INTEGER, "width": INTEGER, "mm_per_pixel": NUMBER, "sensor": SENSOR, "calibration": OTHERS}
COMMON |= {"gradient": BAD_GRADIENT, "initial": BAD_POSE, "rectify": [sensor(), "digit", vts.Rectify(vts.Sensor.load("digit"))]}
"""What an argument of this name refuses where its entry says nothing else."""
