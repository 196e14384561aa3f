"""The columns of frames.csv that printed dots give: shift, turn and stuck share of the object."""

import csv

import numpy as np
import pytest
import torch

import torchvts as vts
from torchvts import stream as streams
from torchvts.scenes import DottedSkin, Drag

SKIN = DottedSkin(120, 160, 0.125)


class Film:
    """A reader of drawn frames."""

    name, live, fps = "a film", False, 30.0

    def __init__(self, images):
        self.images = iter(images)

    def read(self):
        image = next(self.images, None)
        return None if image is None else np.rint(255.0 * image.flip(0).permute(1, 2, 0).numpy()).astype(np.uint8)

    def close(self):
        pass


def unit(skin):
    return vts.Calibration.from_lights(SKIN.lights, vts.Sensor("rig", 120, 160, 0.125), skin)


def test_the_object_that_drags_the_skin_is_followed(tmp_path):
    drags = [Drag(press_mm=0.5, shift_mm=(0.1 * k, -0.05 * k), turn_deg=1.0 * k) for k in range(4)]
    film = Film([SKIN.image(), *(SKIN.image(drag) for drag in drags)])
    with streams.TactileStream(film, unit(SKIN.image()), background_frames=0) as stream:
        report = streams.StreamReport(stream, motion=True)
        for frame in stream:
            report.add(frame)
    report.save(tmp_path)
    rest, *rows = csv.DictReader((tmp_path / "frames.csv").read_text().splitlines())
    assert [rest[name] for name in report.OF_OBJECT] == [""] * 4  # nothing touches
    for row, drag in zip(rows, drags, strict=True):
        found = torch.tensor([float(row["shift_x_mm"]), float(row["shift_y_mm"])])
        assert float((found - torch.tensor(drag.shift_mm)).norm()) < 0.02
        assert float(row["turn_deg"]) == pytest.approx(drag.turn_deg, abs=0.5) and float(row["stuck_share"]) > 0.7


def test_a_skin_without_dots_is_refused():
    bare = torch.full((3, 120, 160), 0.5)
    stream = streams.TactileStream(Film([bare]), unit(bare), background_frames=0)
    with stream, pytest.raises(ValueError, match="dots"):
        streams.StreamReport(stream, motion=True)
