"""Claims about several rasters joined into one."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from cosp.dem.blending import edge_weights, grey_levels, mosaic, mosaic_orthophotos


def two_models(height_a=1000.0, height_b=1010.0):
    a, b = np.full((80, 200), np.nan, np.float32), np.full((80, 200), np.nan, np.float32)
    a[5:75, :130] = height_a
    b[5:75, 70:] = height_b
    return a, b


def test_a_mosaic_has_no_step_where_two_models_differ():
    joined = mosaic(two_models(), ramp_cells=40)
    assert_allclose(joined[40, :70], 1000, atol=1e-3)
    assert_allclose(joined[40, 130:], 1010, atol=1e-3)
    steps = np.abs(np.diff(joined[5:75], axis=1))
    assert steps.max() < 0.8  # 10 m over 60 shared cells
    assert np.isnan(joined[:5]).all()


def test_the_order_of_the_models_does_not_matter():
    a, b = two_models()
    assert_allclose(mosaic([a, b], ramp_cells=40), mosaic([b, a], ramp_cells=40), atol=1e-3)


def test_one_model_alone_stays_as_it_is():
    a, _ = two_models()
    a[40, 40] = np.nan
    assert_allclose(mosaic([a], ramp_cells=40), a)


def test_a_hole_is_filled_by_the_other_model_without_a_step():
    a, b = two_models()
    a[30:50, 85:100] = np.nan
    joined = mosaic([a, b], ramp_cells=15)
    assert_allclose(joined[40, 92], 1010, atol=1e-3)
    assert np.abs(np.diff(joined[5:75], axis=1)).max() < 2.5
    assert np.abs(np.diff(joined[5:75], axis=0)).max() < 2.5


def test_an_edge_that_all_models_share_does_not_fade():
    a, b = (np.isfinite(model) for model in two_models())
    weights = edge_weights(a, a | b, ramp_cells=20)
    assert weights[5, 50] == weights[40, 0] == 1
    assert weights[40, 129] < 0.01
    assert not weights[:5].any()


def test_orthophotos_join_without_a_step_in_brightness():
    rng = np.random.default_rng(2)
    ground = np.clip(rng.normal(120, 25, (80, 200)), 20, 230)
    a, b = ground.copy(), 0.6 * ground + 60  # another exposure
    a[:, 130:] = 0
    b[:, :70] = 0
    joined = mosaic_orthophotos([a.astype(np.uint8), b.astype(np.uint8)], ramp_cells=30)
    assert joined.dtype == np.uint8
    assert np.abs(joined.astype(float) - ground).max() < 6
    assert mosaic_orthophotos([np.zeros((5, 5), np.uint8)], ramp_cells=3).max() == 0


def test_tiles_with_halo_and_common_levels_give_the_whole_mosaic_of_orthophotos():
    rng = np.random.default_rng(5)
    ground = np.clip(rng.normal(120, 25, (80, 200)), 20, 230)
    a, b = ground.astype(np.uint8), (0.6 * ground + 60).astype(np.uint8)
    a[:, 130:] = 0
    b[:, :70] = 0
    levels = grey_levels([a, b], ramp_cells=20)
    whole = mosaic_orthophotos([a, b], ramp_cells=20, levels=levels)
    halo = 21
    for start in range(0, 200, 50):
        low, high = max(start - halo, 0), min(start + 50 + halo, 200)
        tile = mosaic_orthophotos([a[:, low:high], b[:, low:high]], ramp_cells=20, levels=levels)
        assert_allclose(tile[:, start - low : start - low + 50], whole[:, start : start + 50], atol=1)
