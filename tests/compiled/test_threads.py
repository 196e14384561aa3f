"""One thread for many small steps, and the number from before afterwards."""

import torch

from torchvts.core.threads import MOST_PIXELS, one_thread


def test_the_number_of_threads_comes_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with one_thread(MOST_PIXELS), one_thread(1):
            assert torch.get_num_threads() == 1
            with one_thread(MOST_PIXELS + 1):  # a large image: nothing is changed
                assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
        with one_thread(MOST_PIXELS + 1):
            assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
