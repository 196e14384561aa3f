"""One thread for many small steps, and the number from before afterwards."""

from concurrent.futures import ThreadPoolExecutor

import torch

from torchvts.core.threads import MOST_PIXELS, OneThread


def test_the_number_of_threads_comes_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with OneThread(MOST_PIXELS), OneThread(1):
            assert torch.get_num_threads() == 1
            with OneThread(MOST_PIXELS + 1):  # a large image: nothing is changed
                assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
        with OneThread(MOST_PIXELS + 1):
            assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_callers_at_once_leave_the_number_as_it_was():
    def work(_: int) -> int:
        with OneThread(1):
            torch.zeros(100).sum()
            return torch.get_num_threads()

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with ThreadPoolExecutor(4) as pool:
            assert set(pool.map(work, range(40))) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
