"""Windows cover what they should, once."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from cosp.imaging.windows import Window, cosine_weights, strip_of, strips, tiles, worked_on


@pytest.mark.parametrize("overlap", [0, 3])
def test_tiles_cover_a_raster(overlap):
    count = np.zeros((23, 41), int)
    for window in tiles(count.shape, 10, overlap):
        count[window.slices] += 1
    assert count.min() == 1
    assert (count.max() > 1) == (overlap > 0)


def test_strips_are_in_order_and_share_nothing():
    pieces = strips(103, 7)
    assert pieces[0][0] == 0
    assert pieces[-1][1] == 103
    assert all(a[1] == b[0] for a, b in zip(pieces[:-1], pieces[1:], strict=True))
    assert {b - a for a, b in pieces} <= {14, 15}
    assert strip_of(103, "3-of-7") == pieces[2]


@pytest.mark.parametrize("threads", [1, 3])
def test_windows_are_worked_on_in_order_and_not_too_far_ahead(threads):
    windows = tiles((20, 100), 10)
    asked, taken = [], []

    def one_by_one():
        for window in windows:
            assert len(asked) - len(taken) <= 5
            asked.append(window)
            yield window

    with ThreadPoolExecutor(threads) as pool:
        for window, column in worked_on(pool, lambda window: window.column0, one_by_one(), ahead=5):
            assert column == window.column0
            taken.append(window)
    assert taken == asked == windows


def test_a_halo_ends_at_the_edge_of_the_raster():
    assert Window(0, 10, 5, 15).grown(4, (12, 100)) == Window(0, 12, 1, 19)
    assert Window(4, 6, 5, 15).inside(Window(2, 8, 1, 19)) == Window(2, 4, 4, 14)


def test_weights_of_neighbouring_tiles_add_up_to_one():
    ramp = cosine_weights((1, 40), 10)[0] / cosine_weights((1, 40), 10)[0].max()
    assert np.allclose(ramp[:10] + ramp[-10:], 1.0)
