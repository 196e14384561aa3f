"""Pose bench: from rendered noisy images to pose, for seven objects and three whose pose is ambiguous; table, JSON, pictures.

python scripts/pose_bench.py --poses 100 --out out/pose_bench
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

import torchvts as vts
from lab.commands import main_of, parser_of
from lab.pose_accuracy import PoseCase, ball_pairs, pose_table, run_poses
from lab.rows import to_json, write_files
from lab.timing import machine
from torchvts import viz
from torchvts.pose import Registration, contact_cloud
from torchvts.scenes import objects


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--poses", type=int, default=100, help="poses of each object")
    parser.add_argument("--only", nargs="+", choices=[*objects.TARGETS, *objects.FREE_TARGETS], help="these objects")
    parser.add_argument("--clouds", type=int, metavar="POINTS", help="register clouds of so many points instead (0: all pixels)")
    parser.add_argument("--presses", type=Path, metavar="FOLDER", help="also pairs of real presses of a ball: a calibration folder")
    parser.add_argument("--sensor", default="gelsight_mini", help="sensor of that folder, with a prior")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    everything = {**objects.TARGETS, **objects.FREE_TARGETS}
    targets = {name: everything[name] for name in arguments.only or everything}

    def by_clouds(case: PoseCase) -> Registration:
        (s, n_s), (t, n_t) = (contact_cloud(f, case.mm_per_pixel, arguments.clouds or None) for f in (case.source, case.target))
        return vts.register_points(s, t, source_normals=n_s, target_normals=n_t)

    options = {} if arguments.clouds is None else {"register": by_clouds}
    with tqdm(total=arguments.poses * len(targets), unit="pose", disable=None) as bar:
        rows, shown = run_poses(targets, arguments.poses, progress=bar.update, **options)
    for name, (case, found) in shown.items():
        clouds = [contact_cloud(frame, case.mm_per_pixel, 4000)[0] for frame in (case.source, case.target)]
        figure = viz.pose_figure(clouds[0], clouds[1], found.T_target_source, f"{name}: {found.message}")
        viz.save_figure(figure, arguments.out / f"{name.replace(' ', '_')}.png")
    how = f"{arguments.poses} poses each, 320 x 240, noise 0.005 and 8 bits; {machine()}"
    text = f"{how}\n\n{pose_table(rows)}\n"
    if arguments.presses is not None:
        background, presses = vts.read_presses(arguments.presses)
        with tqdm(total=100, unit="pair", disable=None) as bar:
            counts = ball_pairs(background, presses, vts.Sensor.load(arguments.sensor), 100, bar.update)
        text += "\nreal presses of a ball: " + ", ".join(f"{name} {count}" for name, count in counts.items()) + "\n"
    write_files(arguments.out, {"table.md": text, "poses.json": to_json(rows)})
    print(text)
    for row in rows:
        if row.note:
            print(f"{row.data}, refused: {row.note}")
    return 0


if __name__ == "__main__":
    main_of(main)
