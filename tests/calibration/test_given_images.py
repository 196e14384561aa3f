"""Images that a calibration refuses, or leaves out, because they cannot be of one unit, taken in the same way."""

import dataclasses

import pytest
import torch
from conftest import calibrated, half_drawn

import torchvts as vts
from torchvts.calibration.given_images import sort_presses
from torchvts.calibration.resting import beside_presses
from torchvts.model.usable import FrameCheck

NUMBERS = (0, 3)


@pytest.fixture(scope="module", params=NUMBERS)
def given(request):
    """Background and presses of a drawn sensor."""
    unit = half_drawn(request.param)
    return unit.background.float(), [dataclasses.replace(ball, image=ball.image.float()) for ball in unit.balls]


def changed(presses, change):
    return [dataclasses.replace(press, image=change(press.image)) for press in presses]


def crop(image):
    """The upper left of an image, 0.8 of its height and width, at its size."""
    height, width = image.shape[1:]
    part = image[None, :, : round(0.8 * height), : round(0.8 * width)]
    return torch.nn.functional.interpolate(part, (height, width), mode="bilinear", antialias=True)[0]


MISTAKES = {
    "channels": (
        lambda image: image.flip(0),
        "expected the background's view of the skin in its light, got .*swapped to the order B, G, R ",
    ),
    "channels 2": (
        lambda image: image[[1, 2, 0]],
        "channels swapped to the order G, B, R \\(2?[0-9]% off the background with that undone",
    ),
    "turned": (lambda image: image.flip(1, 2), "is turned by 180 degrees \\([0-9]% off the background with that undone"),
    "mirrored": (lambda image: image.flip(2), "is mirrored left to right \\([0-9]% off the background"),
    "both": (lambda image: image.flip(0, 1), "is mirrored top to bottom and has its channels swapped to the order B, G, R"),
    "cropped": (crop, "(shows less than the background, by 10% of each side|another light, or another crop)"),
    "12 bits": (
        lambda image: (image * 4080).round() / 65535,
        r"is dark, 6% of the background's brightness: .*12 bits",
    ),
    "black": (lambda image: 0.0 * image, "one colour everywhere: black"),
    "overexposed": (lambda image: (9.0 * image).clamp(max=1.0), "(is overexposed|one colour everywhere)"),
}


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_presses_taken_otherwise_than_the_background_are_refused(given, mistake, count):
    background, presses = given
    change, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=f"^presses: .*{message}"):
        sort_presses(background, changed(presses[:count], change))


def test_calibration_and_streams_say_the_same_of_an_image(given):
    background, presses = given
    check, named = FrameCheck(background), set()
    for change, _ in MISTAKES.values():
        image = change(presses[0].image)
        if (flaw := check.flaw(image[None])) is not None:
            named.add(flaw.name)
            assert check(image[None]) == f"the frame {flaw.text}"
            with pytest.raises(ValueError, match="got 1 of 1 that are none") as caught:
                sort_presses(background, changed(presses[:1], change))
            assert flaw.text in str(caught.value)
    assert {"swapped", "turned", "dark", "one_colour"} <= named and check.flaw(presses[0].image[None]) is None


@pytest.mark.parametrize("count", [1, 3, 12])
def test_presses_of_the_unit_are_kept(given, count):
    background, presses = given
    assert sort_presses(background, presses[-count:]) == (presses[-count:], [])
    again = sort_presses(background, [presses[0]] * count)  # one press once more is no second one
    assert again == ([presses[0]], [(k, f"it is {presses[0].name} once more") for k in range(1, count)])


def test_one_image_with_two_diameters_is_refused(given):
    background, presses = given
    twice = dataclasses.replace(presses[0], ball_diameter_mm=9.0, name="again")
    with pytest.raises(
        ValueError, match=r"^presses: expected one diameter for an image, got .* for .* and 9 mm for again, which are"
    ):
        sort_presses(background, [*presses[:2], twice])


def test_presses_of_another_unit_are_refused():
    one, other = half_drawn(0), half_drawn(5)
    with pytest.raises(
        ValueError, match=r"presses: expected the light of the background, got .*: another unit, another light, or another crop"
    ):
        sort_presses(one.background, other.balls)


def test_a_dark_background_is_named(given):
    background, presses = given
    with pytest.raises(ValueError, match=r"background: expected a brightness like that of the presses, got 6% .*12 bits"):
        sort_presses((background * 4080).round() / 65535, presses)


@pytest.mark.parametrize("count", [1, 6])
def test_a_background_with_a_contact_is_doubted(given, count):
    _, presses = given
    assert beside_presses(presses[0].image, presses[-count:]).startswith(
        "background: was a press given as the background? take it again without contact"
    )


def test_the_edge_of_a_channel_that_a_camera_cuts_off_is_no_contact(given):
    """It moves with the exposure; a press that lies where the channel is lit is seen all the same."""
    background, presses = given

    def cut(image, level):
        ramp = torch.linspace(0.15, 1.5, image.shape[2])
        return torch.stack((image[0], image[1], (image[2] * ramp - level * image[2].mean()).clamp(0.0, 1.0)))

    others = changed(presses[4:8], lambda image: cut(image, 0.5))
    assert beside_presses(cut(background, 0.4), others) == ""
    right = max(presses, key=lambda press: press.center_px[0])
    assert beside_presses(cut(right.image, 0.4), others) != ""


def test_a_press_that_is_no_press_and_a_spot_on_the_lens_are_no_contact_in_the_background(given):
    background, presses = given
    noisy = background + 0.004 * torch.randn(background.shape, generator=torch.Generator().manual_seed(0))
    blank = dataclasses.replace(presses[0], image=noisy.clamp(0, 1))
    assert sort_presses(background, [blank])[1] == [] and beside_presses(background, [blank]) == ""
    spot = background.clone()
    spot[:, 100:112, 100:112] *= 0.8
    assert len(sort_presses(spot, presses)[0]) == 12 and beside_presses(spot, presses) == ""


def test_one_press_with_swapped_channels_is_left_out_by_name():
    unit = half_drawn(0)
    presses = [dataclasses.replace(ball, name=f"ball {k}") for k, ball in enumerate(unit.balls[:6])]
    presses[2] = dataclasses.replace(presses[2], image=presses[2].image.flip(0))
    calibration, warned = calibrated(unit.background, unit.sensor, presses)
    assert any(text.startswith("ball 2: left out: it has its channels swapped to the order B, G, R") for text in warned)
    rows = calibration.report["presses"]
    assert [row["name"] for row in rows] == [press.name for press in presses]
    assert not rows[2]["used"] and "swapped" in rows[2]["reason"] and rows[1]["used"]
    with pytest.raises(
        ValueError, match=r"^presses: expected the background's view of the skin in its light, got 6 of 6 that are none: ball 0"
    ):
        vts.calibrate(unit.background.flip(0), unit.sensor, [presses[k] for k in (0, 1, 3, 4, 5, 0)])


@pytest.mark.parametrize("name", ["gelsight_mini_a", "digit_b"])
def test_real_presses_are_kept_and_mistakes_refused(data, name):
    if name == "gelsight_mini_a":
        background, presses = vts.read_presses(data / name)
    else:
        background = vts.read_image(data / name / "background.png")
        presses = [vts.Press(vts.read_image(file), 6.0, file.stem) for file in sorted((data / name).glob("ball_*.png"))]
    assert sort_presses(background, presses)[1] == []
    for first in range(0, len(presses) - 2, 3):
        assert len(sort_presses(background, presses[first : first + 3])[0]) == 3
        assert beside_presses(background, presses[first : first + 3]) == ""
    for change, message in MISTAKES.values():
        with pytest.raises(ValueError, match=f"^presses: .*{message}"):
            sort_presses(background, changed(presses[:3], change))
    assert "was a press given as the background?" in beside_presses(presses[4].image, presses[:4] + presses[5:])


@pytest.mark.parametrize("width", [0.3, 0.5, 0.7])
def test_a_black_level_that_has_moved_is_another_light_however_much_of_a_channel_it_cuts_off(given, width):
    """Cells that are black in background and press alike hid it: balls were found at the edge of the light, all in one place."""
    background, presses = given
    fall = (torch.linspace(0.0, 1.0, background.shape[2]) - width) / (1.0 - width)

    def camera(image, black):
        return torch.cat((image[:2], (image[2:] * fall - black).clamp_min(0.0)))

    dark = camera(background, 0.0)
    assert float((dark[2] == 0.0).float().mean()) == pytest.approx(width, abs=0.02)
    same, moved = (changed(presses, lambda image, black=black: camera(image, black)) for black in (0.0, 0.1))
    assert len(sort_presses(dark, same)[0]) == len(presses)
    with pytest.raises(ValueError, match=r"presses: expected the light of the background, got .* that differ from it by"):
        sort_presses(dark, moved)
