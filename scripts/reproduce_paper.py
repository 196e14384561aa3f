"""Reproduce the paper's figure 4 and its tables 2 and 3, beside the values that it reports; examples/paper.py has figure 3.

Ji, Liu, Ma: Model-Based 3D Contact Geometry Perception for Visual Tactile Sensor, Sensors 2022, 22(17), 6470.

    python scripts/reproduce_paper.py [--out out/paper]
"""

import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

import torchvts as vts
from lab import figures, methods, metrics, pose_accuracy
from lab.commands import main_of, parser_of
from lab.sets import data_folder
from lab.training import Training
from torchvts import viz
from torchvts.pose import contact_cloud

PITCH = 0.0625
TACTO = {  # largest error of the paper in px; centre and radius that it found, and the true ones, mm
    "sphere_R10_d2": ("3", "(0.031, 0.032, -7.650), 9.799", "(0, 0, -8), 10"),
    "sphere_R5_d1_off": ("", "", "(8, -5, -4), 5"),
    "cylinder_R4_d1": ("", "", ""),
    "cube_edge_d1": ("", "", ""),
}


def figure_4(folder: Path, out: Path) -> list[str]:
    import numpy as np

    rows = []
    sensor = vts.Sensor.load("tacto")
    for camera in tqdm(["orthographic", "perspective"], desc="figure 4", leave=False, disable=None):
        if not (folder / camera / "background.png").is_file():
            continue
        calibration = vts.calibrate(vts.read_image(folder / camera / "background.png"), sensor)
        pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
        for case, (paper, found_by_paper, sphere) in TACTO.items():
            if not (folder / camera / f"{case}.png").is_file():
                continue
            depth_px = np.load(folder / camera / f"{case}_depth.npz")["depth_px"]
            truth = torch.from_numpy(depth_px).float()[None, None] * PITCH
            with torch.inference_mode():
                result = pipe(vts.read_image(folder / camera / f"{case}.png")[None])
            error = metrics.depth_error(result.depth_mm, truth, PITCH)
            found = ""
            if sphere:
                fit = metrics.fit_sphere(result.depth_mm, PITCH, result.contact)
                found = f"({', '.join(f'{v + 0.0:.3f}' for v in fit.center_mm)}), {fit.radius_mm:.3f}"
            rows.append(
                f"| {camera}, {case} | {paper} | {error.max_px:.2f} ({error.max_mm:.3f} mm) | {error.rms_px:.3f} "
                f"| {found_by_paper} | {found} | {sphere} |"
            )
            figure = figures.comparison_figure(result.depth_mm, truth, PITCH, f"figure 4: TACTO, {camera}, {case}")
            viz.save_figure(figure, out / f"figure_4_{camera}_{case}.png")
    head = "| scene | paper, largest px | ours, largest px | RMS px | paper, sphere centre and radius mm | ours | truth |"
    return [head, "|---|---|---|---|---|---|---|", *rows]


def table_2(folder: Path, out: Path) -> list[str]:
    """RMSE between model-based and look-up depth on real contacts (eq. 11), over the image and over the contact, in px."""
    sensor = vts.Sensor.load("gelsight_mini").without_prior()
    background, presses = vts.read_presses(folder)
    kept = [press for k, press in enumerate(presses) if k % 5 == 0 and press.contact_radius_px is not None]
    training = Training(background, [press for press in presses if press not in kept], sensor)
    table = methods.lookup_table(training).reconstruct
    compared = {"response, precise": methods.by_calibration(training, "precise").reconstruct}
    compared["point lights (the paper's)"] = methods.point_lights(training).reconstruct
    rows = []
    for name, pipe in compared.items():
        for press in tqdm(kept, desc="table 2", leave=False, disable=None):
            with torch.inference_mode():
                one, other = pipe(press.image[None]), table(press.image[None])
            difference = (one.depth_mm - other.depth_mm) / sensor.mm_per_pixel
            image_px = float(difference.square().mean().sqrt())
            contact_px = float(difference[one.contact | other.contact].square().mean().sqrt())
            rows.append((name, press.name, image_px, contact_px))
        figure = figures.comparison_figure(
            one.depth_mm, other.depth_mm, sensor.mm_per_pixel, f"table 2: {name} and look-up table", (name, "look-up table")
        )
        viz.save_figure(figure, out / f"table_2_{name.split(',')[0].split(' (')[0].replace(' ', '_')}.png")
    lines = [f"| {name} | {press} | {image_px:.2f} | {contact_px:.2f} |" for name, press, image_px, contact_px in rows]
    head = "| model against look-up table | press | over the image, px | over the contact, px |"
    return [head, "|---|---|---|---|", *lines, "| paper, point lights | five contacts | | 0.79 to 1.83 |"]


def table_3(out: Path) -> list[str]:
    targets = {name: vts.scenes.objects.TARGETS[name] for name in ("tool handle", "bottle cap", "key")}
    rows, shown = pose_accuracy.run_poses(targets, 10)
    for name, (case, found) in shown.items():
        source, target = (contact_cloud(frame, case.mm_per_pixel, 4000)[0] for frame in (case.source, case.target))
        figure = viz.pose_figure(source, target, found.T_target_source, f"table 3: {name}")
        viz.save_figure(figure, out / f"table_3_{name.replace(' ', '_')}.png")
    lines = []
    for row in rows:
        errors = [f"{statistics.median(row.each[key]):.3f} / {max(row.each[key]):.3f}" for key in ("deg", "mm")]
        lines.append(f"| {row.data} | {' | '.join(errors)} | {statistics.median(row.each['s']):.2f} |")
    head = "| grasped target, 10 poses | angle deg, median / largest | position mm, median / largest | s |"
    return [head, "|---|---|---|---|", *lines, "| paper, three targets | 0.64, 2.35, 2.59 | below 1 | 6 to 8 |"]


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for pictures and table.md")
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder that holds tacto/ (default: TORCHVTS_DATA)")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    tacto = arguments.data / "tacto"
    lines = ["Figure 4: TACTO renders, calibrated from the one background image, precise", ""]
    lines += figure_4(tacto, arguments.out) if tacto.is_dir() else [f"not run: no {tacto} (scripts/render_tacto.py renders it)"]
    mini = arguments.data / "gelsight_mini_a"
    lines += ["", "Table 2: a real GelSight Mini, held-out presses, RMSE between model-based and look-up depth", ""]
    lines += table_2(mini, arguments.out) if mini.is_dir() else [f"not run: no {mini}"]
    lines += [
        "",
        "Table 3: pose against a reference contact, rendered with noise 0.005 and 8 bits, modulo the target's symmetry",
        "",
    ]
    lines += table_3(arguments.out)
    text = "\n".join(lines)
    (arguments.out / "table.md").write_text(text + "\n")
    print(text)
    print(f"\npictures and table.md in {arguments.out}")
    return 0


if __name__ == "__main__":
    main_of(main)
