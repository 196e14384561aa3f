"""Motion of printed dots: errors against drawn truth beside other ways, slip, films, and real sensors there and back; tables.

python scripts/motion.py [pairs field slip film real] [--seeds 10] [--out out/motion]
python scripts/motion.py --picture docs/motion.gif
"""

from collections.abc import Sequence
from pathlib import Path

import torch

from lab import motion
from lab.commands import main_of, parser_of
from lab.rows import write_files
from lab.sets import data_folder

PARTS = ("pairs", "field", "slip", "film", "real")


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--pairs", nargs="+", choices=list(motion.PAIRS), default=list(motion.PAIRS), metavar="PAIR")
    parser.add_argument("--seeds", type=int, default=10, help="noises of each pair, on two skins")
    parser.add_argument("--frames", type=int, default=40, help="of a film")
    parser.add_argument("--limit", type=int, default=8, help="frames of each real sensor")
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the real sensors")
    parser.add_argument("--picture", type=Path, metavar="FILE.gif", help="only draw a film")
    parser.add_argument("--out", type=Path, default=Path("out/motion"))
    arguments = parser.parse_args(argv)
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"parts: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    if arguments.picture is not None:
        motion.picture(arguments.picture, arguments.frames)
        print(f"wrote {arguments.picture}")
        return 0
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts:
        text, rows = tables(part, arguments.pairs, arguments.seeds, arguments.frames, arguments.limit, arguments.data)
        write_files(arguments.out, {f"{part}.md": text + "\n", f"{part}.json": motion.to_json(rows)})
        print(f"{text}\n", flush=True)
    return 0


def tables(part: str, pairs: list[str], seeds: int, frames: int, limit: int, data: Path) -> tuple[str, list[object]]:
    """A part's table in Markdown, and its rows."""
    if part == "pairs":
        rows = list(motion.run_pairs(pairs, seeds))
        return motion.pairs_table(rows), list(rows)
    if part == "field":
        fields = [row for _, _, row in motion.run_fields(max(1, seeds // 3))]
        head = "| field between dots | way | rms, px | worst, px | within 1, 2 sigma |\n|---|---|---|---|---|\n"
        lines = [
            f"| {row.pair} | {row.way} | {row.rms_px:.3f} | {max(map(abs, row.error_px)):.2f} | "
            + ("" if not row.ratio else f"{row.within(1.0):.2f}, {row.within(2.0):.2f}")
            + " |"
            for row in fields
        ]
        return head + "\n".join(lines), list(fields)
    if part == "slip":
        slips = list(motion.run_slips())
        head = (
            "| object moves | stick | stuck share, found / true | shift off, px | turn off, deg | slip rms, px |\n"
            "|---|---|---|---|---|---|\n"
        )
        lines = [
            f"| {row.shift_px:g} px, {row.turn_deg:g} deg | {row.stuck:g} | {row.found:.2f} / {row.true:.2f} | "
            f"{row.shift_error_px:.3f} | {row.turn_error_deg:+.3f} | {row.slip_rms_px:.3f} |"
            for row in slips
        ]
        return head + "\n".join(lines), list(slips)
    if part == "film":
        films = [row for gone in (0.0, 0.5) for row in motion.run_film(frames, gone)]
        head = (
            "| film to 45 px and back | way | rms, px | wrong | missing | of | gone, said to be seen |\n"
            "|---|---|---|---|---|---|---|\n"
        )
        lines = [
            f"| {row.pair} | {row.way} | {row.rms_px:.3f} | {row.wrong} | {row.missing} | {row.dots} | "
            + (f"{row.false} of {row.gone}" if row.gone else "")
            + " |"
            for row in films
        ]
        return head + "\n".join(lines), list(films)
    real = list(motion.run_real(data, limit))
    head = (
        "| sensor | dots | frames | seen | moved, px | there and back: median, 99 % | against Farneback: median, 90 % | "
        "one dot in five left out: rms, within 1, 2 sigma |\n|---|---|---|---|---|---|---|---|\n"
    )
    lines = [
        f"| {row.name} | {row.dots} of {row.diameter_px:.0f} px | {row.frames} | {row.seen:.3f} | {row.largest_px:.1f} | "
        f"{row.back_median_px:.3f}, {row.back_99_px:.2f} | {row.flow_median_px:.3f}, {row.flow_90_px:.2f} | "
        f"{row.left_out_rms_px:.2f}, {row.within_1:.2f}, {row.within_2:.2f} |"
        for row in real
    ]
    return head + "\n".join(lines), list(real)


if __name__ == "__main__":
    main_of(main)
