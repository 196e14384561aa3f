"""Threads that share the work of one compiled frame: equal bits by any number, one caller at a time, forks, a single processor."""

import contextlib
import ctypes
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from test_properties import press_image, unit

import torchvts as vts
from torchvts.accelerated import kernels, reference_only
from torchvts.accelerated.frame import _Prepared, _programs, program_of
from torchvts.accelerated.threads import OneThread, within_frame

SIZES = ((96, 128), (61, 45), (240, 320))

pytestmark = pytest.mark.skipif(kernels.library() is None, reason="no compiled kernels")


@pytest.fixture
def threads():
    """Sets how many threads torch uses, until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def pipe_and_images(size, by="response"):
    """A press, one that the border cuts, and undeformed skin."""
    calibration = unit(by, *size, 28.8 / size[0])
    return vts.DepthPipeline.from_calibration(calibration), [
        press_image(calibration, kind) for kind in ("press", "border", "no contact")
    ]


@pytest.mark.parametrize("by", ["lights", "response"])
@pytest.mark.parametrize("size", SIZES)
def test_any_number_of_threads_gives_equal_bits(size, by, threads):
    pipe, images = pipe_and_images(size, by)
    found = []
    for count in (1, 2, 3, 7, 1):
        threads(count)
        found.append([pipe(image) for image in images for _ in range(2)])
    assert by == "lights" or all(pipe.compiled(image) is not None for image in images)
    for outs in found[1:]:
        assert all(torch.equal(a, b) for one, other in zip(found[0], outs, strict=True) for a, b in zip(one, other, strict=True))


def test_several_callers_at_once(threads):
    """One has the helpers, the others work alone."""
    pipe, images = pipe_and_images((96, 128))
    alone = [pipe(image) for image in images]
    threads(4)
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda k: (k % 3, pipe(images[k % 3])), range(60)))
    assert all(torch.equal(a, b) for k, out in found for a, b in zip(out, alone[k], strict=True))


def test_numbers_of_threads(threads):
    threads(3)
    with OneThread():
        assert torch.get_num_threads() == 1 and within_frame() == 3
    threads(64)
    assert within_frame() == 4
    threads(1)
    assert within_frame() == 1


def test_frames_that_are_begun_and_forgotten(threads):
    """Also while others have the helpers, and in place of another frame; results are as before."""
    pipe, images = pipe_and_images((96, 128))
    alone = [pipe(image) for image in images]
    program, memory = program_of(pipe, pipe.frame_blocks)
    threads(4)

    def begun(k):
        for count in (0, 1, 2, 64):
            for image in images:  # the second is begun while the first is
                kernels.loaded().begin_frame(ctypes.byref(program), image.data_ptr(), count)
            if k % 2:
                kernels.loaded().forget_frame()
        out = pipe(images[k % 3])
        kernels.loaded().forget_frame()
        return k % 3, out

    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(begun, range(60)))
    assert memory
    assert all(torch.equal(a, b) for k, out in found for a, b in zip(out, alone[k], strict=True))


def test_a_frame_that_was_left_begun_does_not_stand_for_the_next(threads):
    """As where a signal's handler calls the pipeline with other values in the same memory."""
    pipe, images = pipe_and_images((96, 128))
    threads(2)
    expected, buffer = pipe(images[1]), images[0].clone()
    pipe(buffer)
    program = _programs[pipe].program
    kernels.loaded().begin_frame(ctypes.byref(program), buffer.data_ptr(), 2)
    time.sleep(0.05)  # helpers are done with it
    buffer.copy_(images[1])
    assert all(torch.equal(a, b) for a, b in zip(pipe(buffer), expected, strict=True))


def test_an_error_after_a_frame_is_begun_leaves_none(threads, monkeypatch):
    pipe, images = pipe_and_images((96, 128))
    threads(2)
    expected, buffer = pipe(images[1]), images[0].clone()
    pipe(buffer)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(_Prepared, "holds", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        pipe(buffer)
    buffer.copy_(images[1])
    assert all(torch.equal(a, b) for a, b in zip(pipe(buffer), expected, strict=True))


def test_what_changes_after_a_frame_is_begun_counts(threads):
    """Helpers begin with the program that was; where blocks have changed, all is done anew."""
    pipe, images = pipe_and_images((96, 128))
    threads(4)
    before = pipe(images[0])
    gain = pipe.compensate.gain
    changes = [
        lambda: gain.gain.mul_(1.5),
        lambda: setattr(gain, "gain", gain.gain / 1.5),
        lambda: setattr(gain.gain, "data", gain.gain.data * 1.25),
        lambda: gain.gain.mul_(0.8),
    ]
    for change in changes:
        change()
        found = pipe(images[0])
        with reference_only():
            expected = pipe(images[0])
        assert (found.depth_mm - expected.depth_mm).abs().max() < 1e-4
        assert torch.equal(found.deformed, expected.deformed)
    assert (pipe(images[0]).depth_mm - before.depth_mm).abs().max() < 1e-4
    rows_of_pixels = images[0].permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    assert not rows_of_pixels.is_contiguous() and torch.equal(pipe(rows_of_pixels).depth_mm, pipe(images[0]).depth_mm)
    depth = pipe(images[0]).depth_mm
    for wrong in (images[0] * 3.0, images[0][..., :100], images[0].double()):
        with contextlib.suppress(ValueError, TypeError):
            pipe(wrong)
        assert torch.equal(pipe(images[0]).depth_mm, depth)


def test_the_way_from_core_to_core_is_timed():
    """Zero where no second thread comes; nobody waits for ever, and frames are as before."""
    pipe, images = pipe_and_images((96, 128))
    alone = pipe(images[0])
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: kernels.loaded().exchange_ns(), range(40)):
            assert 0.0 <= found < 1e6
    assert all(torch.equal(a, b) for a, b in zip(pipe(images[0]), alone, strict=True))


@pytest.fixture
def begun(monkeypatch):
    """Addresses of the images that a frame was begun with."""
    addresses, begin = [], kernels.loaded().begin_frame

    def record(program, image, count):
        addresses.append(image)
        return begin(program, image, count)

    monkeypatch.setattr(kernels.loaded(), "begin_frame", record)
    return addresses


def test_a_frame_is_begun_only_where_its_memory_is_known(threads, begun):
    """Not where the first stage would read memory that may be gone, nor images that have none of their own."""
    pipe, images = pipe_and_images((96, 128))
    threads(2)
    expected = pipe(images[0])
    pipe(images[0])
    assert begun == [images[0].data_ptr()]
    begun.clear()
    gain = pipe.compensate.gain.gain
    gain.data = gain.data.clone()
    assert torch.equal(pipe(images[0]).depth_mm, expected.depth_mm) and not begun
    pipe(images[0])
    assert begun == [images[0].data_ptr()]
    begun.clear()
    slope = torch.func.grad(lambda image: pipe(image).depth_mm.sum())(images[0])
    assert slope.abs().max() > 0.0 and not begun
    found = pipe(torch._neg_view(-images[0]))
    assert (found.depth_mm - expected.depth_mm).abs().max() < 1e-5 and torch.equal(found.deformed, expected.deformed)
    begun.clear()
    assert torch.equal(pipe(torch._efficientzerotensor((1, 3, 96, 128))).depth_mm, pipe(torch.zeros(1, 3, 96, 128)).depth_mm)
    assert 0 not in begun


def test_nobody_is_at_a_forgotten_frame_any_more(threads):
    """The next frame takes its memory at once, which a helper that is late would write into."""
    pipe, images = pipe_and_images((240, 320))
    threads(2)
    expected = pipe(images[1])
    pipe(images[0])
    program = _programs[pipe].program
    for k in range(100):
        kernels.loaded().begin_frame(ctypes.byref(program), images[0].data_ptr(), 2)
        time.sleep(1e-5 * (k % 20))  # a helper comes some time after it is woken
        kernels.loaded().forget_frame()
        assert all(torch.equal(a, b) for a, b in zip(pipe(images[1]), expected, strict=True))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_fork_starts_its_own_helpers(threads):
    threads(2)
    pipe, images = pipe_and_images((96, 128))
    expected = pipe(images[0]).depth_mm
    child = os.fork()
    if child == 0:  # pragma: no cover, another process
        code = 1
        try:
            code = int(not all(torch.equal(pipe(images[0]).depth_mm, expected) for _ in range(20)))
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert torch.equal(pipe(images[0]).depth_mm, expected)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="no affinity")
def test_a_caller_bound_to_one_processor_works_alone(threads):
    threads(2)
    pipe, images = pipe_and_images((96, 128))
    expected = pipe(images[0]).depth_mm
    allowed = os.sched_getaffinity(0)
    try:
        for processor in sorted(allowed)[:2]:
            os.sched_setaffinity(0, {processor})
            assert torch.equal(pipe(images[0]).depth_mm, expected)
    finally:
        os.sched_setaffinity(0, allowed)
    assert torch.equal(pipe(images[0]).depth_mm, expected)
