import numpy as np
import pytest

from cosp.dense.coarse_to_fine import match
from cosp.dense.resampling import SmoothField, StartInterval
from cosp.dense.validity import Validity
from cosp.imaging.windows import Window
from tests.dense.synthetic import render, texture

PERIOD_PX = 24
INNER = np.s_[20:-20, 60:300]


def interval(lowest, highest, step_px=60):
    return StartInterval(
        *(SmoothField(np.asarray(v, np.float32), 0.0, 0.0, float(step_px), float(step_px)) for v in (lowest, highest))
    )


@pytest.fixture(scope="module")
def repeated():
    """Ground that repeats itself every 24 px along the rows, leaning a little."""
    rows, columns = np.mgrid[:240, :420]
    one = texture((240, 3 * PERIOD_PX), np.random.default_rng(5), finest_px=0.7)[:, :PERIOD_PX]
    ground = np.tile(one, (1, 420 // PERIOD_PX + 1))[:, :420]
    return render(ground, 40 + 0.01 * columns + 0.02 * rows, rng=np.random.default_rng(1))


def share_right(pair, found):
    error = np.abs(found.disparity - pair.disparity)[INNER]
    return (error < 1).mean()


def test_repeated_texture_is_matched_where_the_interval_says(repeated, settings):
    plain = match(repeated.left, repeated.right, (0, 120), **settings)
    start = interval(np.full((5, 8), 34.0), np.full((5, 8), 58.0))
    bound = match(repeated.left, repeated.right, (0, 120), start=start, **settings)
    assert share_right(repeated, plain) < 0.5
    assert share_right(repeated, bound) > 0.95


def test_nothing_outside_a_wrong_interval_is_given(pair, settings):
    found = match(
        pair.left, pair.right, (0, 96), start=interval(np.full((5, 8), 60.0), np.full((5, 8), 70.0)), **settings
    )
    given = found.disparity[found.validity == 0]
    assert given.size < 0.001 * found.disparity.size
    assert ((given >= 60) & (given <= 70)).all()
    assert (found.validity & Validity.AT_RANGE_EDGE != 0).mean() > 0.3


def test_where_the_interval_is_the_whole_range_nothing_changes(pair, settings):
    lowest, highest = np.zeros((5, 8)), np.full((5, 8), 96.0)
    lowest[:, :2], highest[:, :2] = 60.0, 70.0  # wrong, up to column 120 at most
    plain = match(pair.left, pair.right, (0, 96), **settings)
    found = match(pair.left, pair.right, (0, 96), start=interval(lowest, highest), **settings)
    assert (found.validity[20:-20, 10:50] == 0).mean() < 0.05
    free = np.s_[:, 200:370]  # what both pictures see
    assert ((plain.validity == 0) == (found.validity == 0))[free].mean() > 0.998
    both = (plain.validity == 0)[free] & (found.validity == 0)[free]
    assert (np.abs(plain.disparity - found.disparity)[free][both] > 0.25).mean() < 0.002


def test_an_interval_is_bilinear_between_its_nodes_and_halves_with_every_level():
    nodes = np.add.outer(np.arange(5.0) * 60, np.arange(8.0) * 60)  # row + column
    whole = interval(nodes, nodes + 8)
    lowest, highest = whole.over(Window(10, 14, 20, 26), 0)
    np.testing.assert_allclose(lowest, np.add.outer(np.arange(10, 14), np.arange(20, 26)), atol=1e-4)
    np.testing.assert_allclose(highest - lowest, 8, atol=1e-4)
    lowest, _ = whole.over(Window(5, 7, 10, 13), 2)
    np.testing.assert_allclose(lowest, np.add.outer(np.arange(5, 7), np.arange(10, 13)), atol=1e-4)
