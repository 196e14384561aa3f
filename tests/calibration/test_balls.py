"""Where balls are in presses of sensors whose light changes far from the contact, and where loop closure moves them."""

import dataclasses
import math
import re

import pytest
import torch
from test_presses import BALL_MM, CENTERS_MM, GIVEN, HEIGHT, PITCH, WIDTH, background, ball, seen_by_curve, take_presses

import torchvts as vts
from torchvts.calibration import closure
from torchvts.calibration.contacts import read_contacts
from torchvts.calibration.given_images import sort_presses
from torchvts.calibration.press_model import by_presses, with_preprocessing

PREPARED = with_preprocessing(GIVEN, None)


def far(level):
    """A smooth change of light over the whole image, another one in each channel."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return 1.0 + level * torch.stack((x, y - 0.3 * x * y, 0.5 * x * x - y))


def changed(press, level):
    return dataclasses.replace(press, image=(press.image * far(level)).clamp(0, 1))


def read(*presses):
    return read_contacts(presses, background(), PREPARED)


@pytest.mark.parametrize("level", [0.0, 0.03, 0.07])
def test_a_far_field_is_not_contact(level):
    """The region holds the contact and stays near it, though the mask is most of the image."""
    center = (5, 3)
    (contact,) = read(changed(vts.Press(seen_by_curve(ball(center, 0.5), 3), BALL_MM), level))
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    r = torch.hypot((x - (WIDTH - 1) / 2) * PITCH - center[0], (y - (HEIGHT - 1) / 2) * PITCH - center[1])
    bare = math.sqrt(BALL_MM * 0.5 - 0.25)
    assert contact.reason == ""
    assert bool(contact.mask[r < 0.85 * bare].all()) and not bool(contact.mask[r > 2.0 * bare].any())


def test_presses_with_a_far_field_are_all_used_and_located():
    presses = [changed(press, 0.02 * (-1) ** k) for k, press in enumerate(take_presses(count=9))]
    _, contacts = by_presses(background(), GIVEN, presses, None)
    off = [math.dist(c.center_mm.tolist(), at) / PITCH for c, at in zip(contacts, CENTERS_MM)]
    assert [c.reason for c in contacts] == [""] * 9 and max(off) < 2.0, off


@pytest.mark.parametrize(
    "level, cause",
    [(1 / 16, "is dark, 6% of the background's brightness: .*12 bits stored in 16"), (0.0, "one colour everywhere: black")],
)
def test_a_dark_press_is_named(level, cause):
    with pytest.raises(ValueError, match=f"got 1 of 1 that are none: .*{cause}"):
        sort_presses(background(), [vts.Press(level * seen_by_curve(ball(), 3), BALL_MM)])


def test_saturated_pixels_are_fitted_too():
    """Frames have them, and a field that has not seen them is far off there."""
    image = seen_by_curve(ball((0, 0), 0.5), 3)
    image[0, 55:65, 70:76] = 1.0
    (contact,) = read(vts.Press(image, BALL_MM, center_px=((WIDTH - 1) / 2, (HEIGHT - 1) / 2)))
    rows, columns = contact.index // WIDTH, contact.index % WIDTH
    clipped = (rows >= 55) & (rows < 65) & (columns >= 70) & (columns < 76)
    assert contact.reason == "" and bool(clipped.any()) and torch.equal(contact.saturated, clipped)
    assert bool((contact.inside() & clipped).any())


def located(shift_px):
    """Presses with centers that are all off by the same shift."""
    contacts = read(*take_presses(count=10))
    for contact, at, depth in zip(contacts, CENTERS_MM, [0.5, 0.4, 0.6, 0.45, 0.55, 0.5, 0.4, 0.6, 0.5, 0.35]):
        contact.center_mm = torch.tensor(at, dtype=torch.float64) + PITCH * torch.tensor(shift_px, dtype=torch.float64)
        contact.contact_radius_mm = math.sqrt(BALL_MM * depth - depth**2)
    return contacts


def test_loop_closure_never_moves_known_balls_or_right_ones_far():
    contacts = located((0, 0))
    contacts[0].known = True
    closure.close_loops(contacts, 10.0)
    off = [math.dist(c.center_mm.tolist(), at) / PITCH for c, at in zip(contacts, CENTERS_MM)]
    assert off[0] == 0.0 and max(off) < 1.0, off


def test_presses_of_a_digit_are_used(data):
    folder = data / "digit_a"
    sensor = vts.Sensor("digit", 320, 240, 1 / 19.58, gamma=1.0)
    presses = [vts.Press(vts.read_image(folder / f"ball_{k:04d}.png"), 4.70, f"ball {k}") for k in range(0, 40, 5)]
    contacts = read_contacts(presses, vts.read_image(folder / "background.png"), with_preprocessing(sensor, None))
    assert [contact.reason for contact in contacts] == [""] * len(presses)
    assert all(0.05 < float(contact.mask.double().mean()) < 0.4 for contact in contacts)


def test_a_label_far_from_the_contact_is_left_out():
    presses = take_presses(count=6)
    middle = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    labels = [(middle + torch.tensor(at) / PITCH).tolist() for at in CENTERS_MM[:6]]
    wrong = (labels[0][0] - 45.0, labels[0][1])
    given = [dataclasses.replace(press, center_px=at) for press, at in zip(presses, [wrong, *labels[1:]])]
    _, contacts = by_presses(background(), GIVEN, given, None)
    assert re.fullmatch("label is 4[3-7] px from the contact: correct it, or leave it out", contacts[0].reason), contacts[0].reason
    assert [contact.reason for contact in contacts[1:]] == [""] * 5


def test_a_spot_beside_the_contact_that_changes_most_costs_no_other_press():
    """A glint of a few pixels, whose colour changes more than that of a wide, gentle contact."""
    presses = take_presses(count=4)
    spotted = presses[0].image.clone()
    spotted[0, 2:9, 3:10] *= 3.0
    spotted[2, 2:9, 3:10] /= 3.0
    given = [dataclasses.replace(presses[0], image=spotted.clamp(0, 1)), *presses[1:]]
    _, contacts = by_presses(background(), GIVEN, given, None)
    assert [contact.reason for contact in contacts[1:]] == [""] * 3
