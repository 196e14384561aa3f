"""Live 3D view of a camera or a recording, with rerun: image, depth, normals, contact, surface, area and deepest point over time.

The first frames must be without contact. Without a screen, --save FILE.rrd records what the viewer would show; rerun FILE.rrd
opens it anywhere. Keys, in this terminal (or letters on standard input): z re-zero (lift the object first), s snapshot,
r start and end a recording, q end. Exit status 1 where a frame was left out or is in doubt, or depth is not metric.

examples:
  torchvts view 0 --sensor gelsight_mini
  torchvts view unit.safetensors /dev/video2 --fps 30
  torchvts view video.avi --sensor gelsight_wedge --save ball.rrd
  torchvts view --web
"""

import argparse
from pathlib import Path

from ..core.files import make_folder
from ..core.results import Facts, write_result
from ..skin import motion_of_unit
from ..stream import Keys, LiveView, StreamReport, TactileFrame, TactileStream, has_screen, require_rerun
from ..stream.view import EXAGGERATION
from ..viz import depth_figure, save_figure
from .options import ended, load_calibration
from .parser import UsageError
from .source import add_source, load_unit, open_stream, play
from .web_page import serve

USAGE = "(CALIBRATION SOURCE [--save FILE.rrd] | --web [CALIBRATION])"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_source(parser, required=False)
    parser.add_argument("--web", action="store_true", help="serve the page that measures in the browser, on this machine alone")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="record from the start; no viewer is opened")
    parser.add_argument("--out", type=Path, metavar="FOLDER", default=Path("out/view"), help="of snapshots and recordings")
    text = f"of heights on the screen ({EXAGGERATION:g})"
    parser.add_argument("--exaggeration", type=float, default=EXAGGERATION, metavar="X", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Show the stream until the source ends or q is pressed, and print a summary."""
    if arguments.web:
        if len(arguments.files) > 1:
            raise UsageError(f"expected at most a calibration beside --web, got {' '.join(arguments.files)}")
        serve(load_calibration(Path(arguments.files[0])) if arguments.files else None)
        return 0
    if not arguments.files:
        raise UsageError("expected CALIBRATION SOURCE, or --web for the page in the browser")
    require_rerun()
    if arguments.save is None and not has_screen():
        raise UsageError("expected --save FILE.rrd, for this machine has no screen that the viewer could open on")
    with open_stream(arguments, *load_unit(arguments)) as stream:
        pitch, viewer = stream.calibration.sensor.mm_per_pixel, arguments.save is None
        view = LiveView(pitch, stream.metric, save=arguments.save, viewer=viewer, exaggeration=arguments.exaggeration)
        with view, Keys() as keys:
            viewing = _Viewing(stream, view, keys, arguments.out)
            lost = play(stream, viewing.add)
    print(viewing.report.table())
    if arguments.save is not None:
        print(f"wrote {arguments.save}; rerun {arguments.save} shows it")
    if lost is not None:
        raise lost
    return ended(stream.metric, stream.left_out or viewing.report.doubted)


class _Viewing:
    """Shows each frame, and does what the keys ask for."""

    def __init__(self, stream: TactileStream, view: LiveView, keys: Keys, out: Path) -> None:
        self.stream, self.view, self.keys, self.out = stream, view, keys, out
        self.report = StreamReport(stream)

    def add(self, frame: TactileFrame) -> bool:
        self.report.add(frame)
        with self.stream.stages.stage("view"):
            self.view.add(frame)
        for key in self.keys.pressed():
            if key == "q":
                return False
            if key == "z":
                self.stream.rezero()
                print(f"frame {frame.number}: the next frames are the new zero")
            elif key == "s":
                self.snapshot(frame)
            elif key == "r":
                self.record(frame)
        return True

    def snapshot(self, frame: TactileFrame) -> None:
        """Write the frame as npz and as a picture."""
        path, sensor = make_folder(self.out) / f"frame_{frame.number:06}.npz", self.stream.calibration.sensor
        metric, doubts, doubt = self.stream.metric, self.stream.calibration.report.get("doubts", []), self.stream.doubt
        write_result(path, frame.output, Facts(sensor.mm_per_pixel, "", sensor.name, metric, doubts), str(frame.number), doubt)
        title, said = f"{sensor.name}, {frame.time_s:.2f} s", [f"IN DOUBT: {doubt}"] if doubt else []
        motion = motion_of_unit(self.stream.calibration)
        output, pitch = frame.output, sensor.mm_per_pixel
        moved = None if motion is None else motion(frame.image[None], output.depth_mm)
        figure = depth_figure(output.depth_mm, pitch, frame.image, output.contact, title, metric=metric, doubts=said, moved=moved)
        save_figure(figure, path.with_suffix(".png"))
        print(f"wrote {path} and .png")

    def record(self, frame: TactileFrame) -> None:
        """Start a recording, or end the one that runs."""
        running = self.view.recording_to
        if running is not None:
            self.view.record(None)
            print(f"wrote {running}")
            return
        path = make_folder(self.out) / f"from_{frame.number:06}.rrd"
        self.view.record(path)
        print(f"recording to {path}")
