"""Symptoms are named: seeded faults, clean frames, real units.

All dials of the gallery at middle severity, 20 seeds each, as docs/diagnose.md has them: python tests/test_diagnose.py --seeds 20
"""

import argparse
import json
import subprocess
import sys
import warnings

import pytest
import torch

import torchvts as vts
from torchvts import scenes
from torchvts.diagnose import Diagnosis, Finding
from torchvts.diagnose.camera import blockiness, levels_of
from torchvts.faults import jpeg
from torchvts.gallery import DIALS, undisturbed

NAMED = {
    "deeper press": {"deep_press"},
    "steep walls": {"steep_walls"},
    "cut ends": {"steep_walls"},
    "cut by the border": {"contact_at_border"},
    "covers the image": {"contact_covers_image"},
    "two contacts": {"several_contacts"},
    "faint contact": {"faint_contact", "no_contact"},
    "gel sag": {"skirt"},
    "attached shadows": {"shadow"},
    "cast shadows": {"cast_shadow"},
    "specular": {"specular"},
    "inter-reflection": {"inter_reflection"},
    "ambient light": {"ambient_light"},
    "a channel dims": {"channel_level"},
    "dead lights": {"light_dead"},
    "a light moves": {"light_moved"},
    "lights close together": {"lights_coplanar"},
    "albedo drift": {"skin_changed"},
    "spots and dead pixels": {"new_spots"},
    "markers": {"markers"},
    "defocus": {"blurred"},
    "motion blur": {"moved"},
    "vignetting": {"vignetting"},
    "lens distortion": {"lens_distortion"},
    "wrong pitch": {"wrong_pitch"},
    "saturation": {"saturated"},
    "black crush": {"black_level"},
    "wrong gamma": {"gamma"},
    "channel order": {"channels_mixed", "channels_swapped"},
    "noise": {"noise"},
    "few bits": {"few_bits"},
    "JPEG": {"compressed"},
}
"""Fault -> findings that name it."""

NOT_SEEN = {"perspective"}
"""A pin-hole camera sees the resting skin as a straight one does; docs/diagnose.md has the figures."""


def middle(dial):
    return dial.severities[len(dial.severities) // 2]


def named(name, seed, severity=None):
    case = DIALS[name].make(middle(DIALS[name]) if severity is None else severity, seed)
    found = vts.diagnose(case.background, case.image, case.calibration)
    return bool(NAMED.get(name, set()) & set(found.names)), found


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--dials", nargs="+", default=list(DIALS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    hits = total = 0
    for name in arguments.dials:
        beside: dict[str, int] = {}
        right = 0
        for seed in range(arguments.seeds):
            hit, found = named(name, seed)
            right += hit
            for finding in found:
                if finding.name not in NAMED.get(name, set()) and finding.severity != "note":
                    beside[finding.name] = beside.get(finding.name, 0) + 1
        print(f"| {name} | {middle(DIALS[name]):g} {DIALS[name].unit} | {right}/{arguments.seeds} | {beside or ''} |", flush=True)
        hits, total = hits + right, total + arguments.seeds
    clean = [vts.diagnose(c.background, c.image, c.calibration) for c in map(undisturbed, range(100, 100 + arguments.seeds))]
    print(f"named {hits} of {total} ({hits / total:.1%}); false alarms on clean frames {sum(not d.ok for d in clean)} of {len(clean)}")


if __name__ == "__main__":
    main()
