"""Threads that share the frames of a batch: equal bits by any number, several callers at once."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from test_properties import press_image, unit

import torchvts as vts
from torchvts.accelerated.threads import MOST_PIXELS, OneThread


@pytest.fixture
def threads():
    """Sets how many threads torch uses, until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def pipe_and_images(size, by="response"):
    """A press, one that the border cuts, and undeformed skin."""
    calibration = unit(by, *size, 28.8 / size[0])
    images = [press_image(calibration, kind) for kind in ("press", "border", "no contact")]
    return vts.DepthPipeline.from_calibration(calibration), torch.cat(images)


@pytest.mark.parametrize("by", ["lights", "response"])
def test_any_number_of_threads_gives_equal_bits(by, threads):
    """Of single frames, and of a batch whose frames threads share."""
    pipe, images = pipe_and_images((240, 320), by)
    batch = images.repeat(2, 1, 1, 1)
    assert batch[:, 0].numel() > MOST_PIXELS
    alone = [pipe(image[None]) for image in images]
    for count in (1, 2, 3, 7):
        threads(count)
        together = pipe(batch)
        for k, expected in enumerate(alone):
            assert all(torch.equal(one, other) for one, other in zip(pipe(images[k : k + 1]), expected, strict=True))
            assert all(torch.equal(one[k::3], other.expand_as(one[k::3])) for one, other in zip(together, expected, strict=True))


def test_several_callers_at_once(threads):
    pipe, images = pipe_and_images((96, 128))
    alone = [pipe(image[None]) for image in images]
    threads(4)
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda k: (k % 3, pipe(images[k % 3][None])), range(60)))
    assert all(torch.equal(a, b) for k, out in found for a, b in zip(out, alone[k], strict=True))


def test_the_number_of_threads_comes_back(threads):
    threads(3)
    with OneThread(), OneThread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
