"""Spread of matches told by their neighbours."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from cosp.io import rasters
from cosp.matching.ground import lattice_rc
from cosp.matching.matchers import structural
from cosp.matching.redundancy import sigma_factor

TEMPLATE = 2.0


def overlapping_matches(rng, sigma_mm, *, side=600, step=0.1):
    """Four points in every tile, half a template apart, tiles two templates apart.

    Errors are means of white noise over the template, as those of matches are.
    """
    box = round(TEMPLATE / step)
    noise = rng.standard_normal((side, side, 2))
    error = np.stack([uniform_filter(noise[..., i], box, mode="wrap") for i in (0, 1)], axis=-1) * box * sigma_mm
    places = np.add.outer(np.arange(0, side - box, 2 * box), [0, box // 2]).ravel()
    rows, columns = (v.ravel() for v in np.meshgrid(places, places, indexing="ij"))
    return np.column_stack([columns, rows]) * step, error[rows, columns]


@pytest.mark.parametrize("truth", [0.3, 1.0, 2.5])
def test_errors_of_overlapping_templates_are_found_whatever_was_stated(truth):
    rng = np.random.default_rng(1)
    film_mm, error = overlapping_matches(rng, 0.02)
    factor = sigma_factor(film_mm, error, np.full(len(error), 0.02 / truth), TEMPLATE)
    assert factor == pytest.approx(truth, rel=0.1)


def test_what_neighbours_share_and_single_errors_do_not_count():
    rng = np.random.default_rng(2)
    film_mm, error = overlapping_matches(rng, 0.02)
    waves = 0.5 * np.stack([np.sin(film_mm[:, 1] / 80), np.cos(film_mm[:, 0] / 80)], axis=-1)
    error[rng.choice(len(error), len(error) // 20, replace=False)] += 3.0
    factor = sigma_factor(film_mm, error + waves + [1.0, -2.0], np.full(len(error), 0.02), TEMPLATE)
    assert factor == pytest.approx(1.0, abs=0.25)


def test_better_and_worse_matches_keep_their_proportion():
    rng = np.random.default_rng(3)
    film_mm, error = overlapping_matches(rng, 1.0)
    sigma = np.where(film_mm[:, 0] < 30.0, 0.01, 0.05)
    assert sigma_factor(film_mm, error * sigma[:, None], 2 * sigma, TEMPLATE) == pytest.approx(0.5, rel=0.1)


def test_nothing_is_said_of_matches_that_stand_alone():
    film_mm = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2) * 5
    assert sigma_factor(film_mm, np.zeros((400, 2)), np.ones(400), TEMPLATE) is None
    assert sigma_factor(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), TEMPLATE) is None


@pytest.mark.parametrize("band", [3, 5])
def test_neighbours_in_real_images_tell_what_distant_matches_confirm(real_data, band):
    july, november = (
        rasters.read(real_data / "pennsylvania" / f"landsat7_2002{day}_b123457.tif", band).astype(np.float32)
        for day in ("0720", "1125")
    )
    found = structural(65, 14, 0.3, 0.9, 1.0).match(july, november, lattice_rc(july.shape, 16, 46), threads=1)
    off = found.fixed_rc - found.moving_rc
    right = np.linalg.norm(off, axis=1) < 3.0
    places, off, sigma = found.moving_rc[right], off[right], found.sigma_px[right]
    first, second = np.triu_indices(len(off), 1)
    apart = np.abs(places[first] - places[second]).max(axis=1) >= 65.0
    difference = (off[first] - off[second])[apart] / np.hypot(sigma[first], sigma[second])[apart, None]
    assert sigma_factor(places, off, sigma, 65.0) == pytest.approx(1.4826 * np.median(np.abs(difference)), rel=0.3)
