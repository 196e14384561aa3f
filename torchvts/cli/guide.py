"""Calibration by hand: a camera watches, sentences say what to do, and the background and each press lie in a folder at once."""

import csv
import itertools
from collections import deque
from pathlib import Path

import torch
from torch import Tensor

from ..calibration import LEAST_WEIGHT, Press
from ..core.checks import in_one_line
from ..core.files import Pixels, check_folder, image_to_bytes, make_folder, rgb_from_bgr, write_atomically
from ..model import Calibration, Sensor
from ..model.gs_sdk import CATALOG_COLUMNS
from ..model.report import PressRow
from ..model.summary import NOT_METRIC, where_next
from ..stream import FIRST_FRAMES, Unreadable, find_background
from ..stream.background import check_steady, is_touched
from ..stream.sources import NumberedFrame
from ..viz import calibration_figure, save_figure
from .options import calibrated, read_folder


class Session:
    """Background and presses of a unit as they come, in a folder of gs_sdk's layout; what lies there already is gone on with.

    ``background`` (3, H, W), None until there is one, and ``presses`` are rectified. A press that was refused stays as an image and
    leaves the catalog, and so does not count.
    """

    def __init__(self, folder: Path, sensor: Sensor) -> None:
        self.folder, self.sensor = check_folder(folder), sensor
        self.background: Tensor | None = None
        self.read()

    def read(self) -> None:
        """Read what lies in the folder."""
        self.presses: list[Press] = []
        if (self.folder / "catalog.csv").is_file():
            self.background, self.presses = read_folder(self.folder, self.sensor)
        elif (self.folder / "background.png").is_file():
            self.background = self.sensor.read_image(self.folder / "background.png")

    def set_background(self, image: Tensor) -> None:
        """Keep the picture without contact."""
        _write_png(make_folder(self.folder) / "background.png", image)
        self.read()

    def add(self, image: Tensor, ball_diameter_mm: float) -> None:
        """Keep a press, the next of the catalog."""
        name = next(str(k) for k in itertools.count(1) if not (self.folder / str(k)).exists())
        _write_png(make_folder(self.folder / name) / "gelsight.png", image)
        self._write_catalog({press.name: press.ball_diameter_mm for press in self.presses} | {name: ball_diameter_mm})

    def leave_out(self, name: str) -> None:
        """Take a press out of the catalog."""
        self._write_catalog({press.name: press.ball_diameter_mm for press in self.presses if press.name != name})

    def _write_catalog(self, diameters_mm: dict[str, float]) -> None:
        rows = [CATALOG_COLUMNS, *((name, f"{diameter_mm:g}") for name, diameter_mm in diameters_mm.items())]
        if diameters_mm:
            with write_atomically(self.folder / "catalog.csv") as temporary, open(temporary, "w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows(rows)
        else:  # which would be none
            (self.folder / "catalog.csv").unlink()
        self.read()


def _write_png(path: Path, image: Tensor) -> None:
    with write_atomically(path) as temporary:
        temporary.write_bytes(image_to_bytes(image).numpy().tobytes())


class Watch:
    """The last :data:`~torchvts.stream.FIRST_FRAMES` frames: are they still, is the skin touched, and one picture of them."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._rectified: deque[Tensor] = deque(maxlen=FIRST_FRAMES)
        self._raw: deque[Pixels] = deque(maxlen=FIRST_FRAMES if sensor.cuts_a_place else 0)

    def add(self, pixels: Pixels) -> None:
        """Take the next frame."""
        self._rectified.append(self.sensor.rectify(rgb_from_bgr(pixels)[None])[0].clamp(0.0, 1.0))
        self._raw.append(pixels)

    def moves(self) -> bool:
        """Whether something moves, or the light changes; also until there are enough frames."""
        if len(self._rectified) < FIRST_FRAMES:
            return True
        try:
            check_steady(torch.stack(list(self._rectified)))
        except ValueError:
            return True
        return False

    def why_not_at_rest(self) -> str:
        """Why the frames are not those of still, untouched skin; "" where they are."""
        if self.moves():
            few = len(self._rectified) < FIRST_FRAMES
            return f"{'' if few else 'something moves, or the light changes: '}keep the sensor still, and off everything"
        try:
            find_background(torch.stack(list(self._rectified)), self.sensor)
        except ValueError:
            return f"something touches the skin, or this is no sensor '{self.sensor.name}': lift everything off it"
        return ""

    def touched(self, background: Tensor) -> bool:
        """Whether the last frame shows a contact."""
        return is_touched(self._rectified[-1], background)

    def picture(self) -> Tensor:
        """Mean of the frames as a folder keeps them: rectified, or raw where the sensor file states the gel's place in raw ones."""
        images = list(self._rectified) if not self._raw else [rgb_from_bgr(pixels) for pixels in self._raw]
        return (sum(images[1:], images[0].double()) / len(images)).float()


def draw(unit: Calibration, presses: list[Press], picture: Path) -> None:
    """Draw what a calibration was made of."""
    make_folder(picture.parent)
    save_figure(calibration_figure(unit, presses), picture)


class Guide:
    """What is said and done at each frame, until the calibration states the error that was asked for.

    ``picture`` is written after each press; ``unit`` is the calibration by the presses that were kept, None before the first.
    """

    def __init__(
        self, session: Session, watch: Watch, ball_diameter_mm: float, until_deg: float, picture: Path, force: bool = False
    ) -> None:
        self.session, self.watch, self.ball_diameter_mm = session, watch, ball_diameter_mm
        self.until_deg, self.picture, self.force = until_deg, picture, force
        self.unit: Calibration | None = None
        self._said, self._where = "", "anywhere, 0.3 to 0.8 mm deep"
        self._lifted = False
        self._say(
            f"{session.folder} keeps the background and each press, {picture} shows them; Ctrl-C ends, the same command goes on"
        )
        if session.presses:  # the last one was perhaps not judged yet
            self._judge()

    @property
    def reached(self) -> bool:
        """Whether the error that was asked for is stated."""
        return self.unit is not None and self.unit.metric and self.unit.report.get("stated_deg", 90.0) <= self.until_deg

    def add(self, frame: NumberedFrame) -> bool:
        """Take the next frame; False where the error is reached."""
        pixels = frame[2]
        if isinstance(pixels, Unreadable):
            self._say(f"a frame cannot be read: {pixels.reason}")
            return True
        self.watch.add(pixels)
        background = self.session.background
        if background is None:
            why = self.watch.why_not_at_rest()
            if not why:
                self.session.set_background(self.watch.picture())
            self._say(why or "still and untouched: the background is taken")
        elif not self.watch.touched(background):
            self._lifted = True
            self._say(f"press the ball of {self.ball_diameter_mm:g} mm and hold it still: {self._where}")
        elif not self._lifted:
            self._say("lift the ball; where that is lifted, other light falls than in the background: begin another --session")
        elif not self.watch.moves():
            self._lifted = False
            self.session.add(self.watch.picture(), self.ball_diameter_mm)
            self._judge()
        return not self.reached

    def _judge(self) -> None:
        """Calibrate by all presses of the session: the last one is kept, or refused with its reason, as may be those before it."""
        session = self.session
        assert session.background is not None
        last = session.presses[-1].name
        refused: list[PressRow] | None = None
        while refused is None or refused:
            if not session.presses:
                return
            try:
                unit = calibrated(session.background, session.sensor, session.presses, self.force)
            except ValueError as error:
                self._refuse(last, in_one_line(error))
                return
            rows = {row["name"]: row for row in unit.report["presses"]}
            refused = [row for row in rows.values() if row["weight"] < LEAST_WEIGHT]
            for row in refused:
                self._refuse(row["name"], row.get("reason", ""))
        draw(unit, session.presses, self.picture)
        self.unit, self._where = unit, where_next(unit) or self._where
        if last in rows:
            row = rows[last]
            (x, y), radius = row["center_px"], row["contact_radius_px"]
            circle = f"a circle at x {x:.0f}, y {y:.0f} px, radius {radius:.0f} px"
            doubt = f" ({row['reason']})" if row.get("reason") else ""
            self._say(f"press {last}: kept{doubt}: {circle}")
        stated = f"normals are expected to about {unit.report['stated_deg']:.1f} degrees"
        count = len(session.presses)
        so_far = stated if unit.metric else f"{NOT_METRIC}: {unit.report['not_metric'][0]}"
        self._say(f"by {count} press{'es' if count > 1 else ''}: {so_far}; {self.until_deg:g} are asked for")

    def _refuse(self, name: str, reason: str) -> None:
        self.session.leave_out(name)
        self._say(f"press {name}: refused: {reason}")

    def _say(self, text: str) -> None:
        """Print a sentence, once until there is another."""
        if text != self._said:
            print(text, flush=True)
        self._said = text
