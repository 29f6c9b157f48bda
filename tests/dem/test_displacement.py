"""Displacements of tiles of a model: found where the relief tells them, said to be open where it does not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.dem.displacement import Displacement, displacements, spread_factor, verdicts

from . import synthetic
from .synthetic import GRID

SHIFT = np.array([25.0, -18.0, 7.0])
CHOICES = {
    "tile_m": 3000.0,
    "least_share": 0.5,
    "max_slope_deg": 60.0,
    "largest_shift_m": 300.0,
    "reference_sigma_m": 0.5,
    "threads": 1,
}


def pair(seed, *, displacement_m=SHIFT, relief_m=250.0):
    """A model with errors that are alike over some cells, and the reference with noise from cell to cell."""
    rng = np.random.default_rng(seed)
    rough = synthetic.ground(rng, relief_m=relief_m)
    errors = gaussian_filter(rng.standard_normal(GRID.shape), 3.0)
    model = synthetic.moved(rough, displacement_m) + 4.0 * errors / errors.std()
    return model.astype(np.float32), synthetic.reference(rough) + 2.5 * rng.standard_normal(GRID.shape).astype("f4")


def found_in(model, reference, stable=None, **choices):
    stable = np.ones(GRID.shape, bool) if stable is None else stable
    return displacements(model, reference, stable, GRID, **CHOICES | choices)


def misfits(found, truth):
    """Errors (N, 3), and their squares by the covariances, per coordinate."""
    errors = np.array([one.shift_m - truth(one.place_m) for one in found])
    inverse = np.linalg.inv([one.covariance_m2 for one in found])
    return errors, np.einsum("ni,nij,nj->n", errors, inverse, errors) / 3


def test_a_shift_is_found_in_every_tile_as_well_as_is_said():
    found = [one for seed in (1, 2, 3) for one in found_in(*pair(seed))]
    assert verdicts(found) == {"kept": 27, "open": 0, "far": 0, "worse": 0}
    errors, squares = misfits(found, lambda place: SHIFT)
    assert (np.abs(errors).max(axis=0) < [5.0, 5.0, 1.5]).all()
    assert 0.5 < np.sqrt(squares.mean()) < 1.3
    sigma = np.sqrt([np.diag(one.covariance_m2) for one in found])
    assert (sigma[:, :2] < 6.0).all()
    assert (sigma > 0.5).all()


def test_a_displacement_that_changes_over_the_model_is_found_where_it_is():
    # 20 m in east over the 9.6 km of the model, and a height that follows.
    def truth(place):
        share = (place[0] - GRID.x0) / (GRID.bounds[2] - GRID.bounds[0])
        return np.array([5.0 + 20.0 * share, -10.0, 12.0 * share])

    rows, columns = np.indices(GRID.shape)
    field = np.apply_along_axis(truth, -1, GRID.points(rows, columns))
    found = found_in(*pair(4, displacement_m=field))
    errors, squares = misfits(found, truth)
    assert np.abs(errors[:, :2]).max() < 5.0
    assert np.abs(errors[:, 2]).max() < 1.5
    assert np.sqrt(squares.mean()) < 1.5
    east = np.array([one.shift_m[0] for one in found])
    assert np.ptp(east) > 10.0


def test_ground_that_has_changed_is_left_out():
    model, reference = pair(5)
    glacier = np.zeros(GRID.shape, bool)
    glacier[40:130, 60:250] = True
    changed = np.where(glacier, reference - np.linspace(0, 120, GRID.shape[1], dtype=np.float32), reference)
    masked, unmasked = (found_in(model, changed, stable) for stable in (~glacier, None))
    errors, _ = misfits(masked, lambda place: SHIFT)
    assert np.abs(errors).max() < 6.0
    assert sum(one.cells for one in masked) < (~glacier).sum() + 1
    errors, _ = misfits(unmasked, lambda place: SHIFT)
    assert np.abs(errors).max() > 20.0
    # A tile that is nearly all glacier says nothing at all.
    assert len(found_in(model, changed, ~glacier, least_share=0.9)) < len(masked)


def test_a_plain_says_that_it_leaves_plan_open():
    found = found_in(*pair(6, relief_m=3.0))
    assert verdicts(found)["open"] == len(found) == 9
    for one in found:
        assert np.linalg.eigvalsh(one.covariance_m2[:2, :2])[0] > 300.0**2
        assert abs(one.shift_m[2] - SHIFT[2]) < 5 * np.sqrt(one.covariance_m2[2, 2]) < 10.0


def test_ridges_tell_what_lies_across_them_alone():
    rng = np.random.default_rng(7)
    across = 250.0 * np.sin(np.arange(GRID.shape[1]) * 2 * np.pi / 40.0) * np.ones((GRID.shape[0], 1))
    model = across + 3.0 * gaussian_filter(rng.standard_normal(GRID.shape), 1.0)
    reference = np.roll(across, 1, axis=1) + 2.5 * rng.standard_normal(GRID.shape)
    found = found_in(model.astype("f4"), reference.astype("f4"))
    assert verdicts(found)["open"] == len(found)
    for one in found:
        assert one.shift_m[0] == pytest.approx(GRID.step_x, abs=3.0)
        assert np.sqrt(one.covariance_m2[0, 0]) < 20.0
        assert np.sqrt(one.covariance_m2[1, 1]) > 500.0


def test_what_is_not_plausible_is_refused():
    far = found_in(*pair(8), largest_shift_m=15.0)
    assert verdicts(far)["kept"] == 0
    assert verdicts(far)["far"] > 0
    model, _ = pair(9)
    # Another ground: no shift lays it on this one.
    other = found_in(model, pair(10)[1])
    assert verdicts(other)["kept"] <= 1


def test_errors_that_whole_tiles_have_in_common_are_told_by_their_neighbours():
    rng = np.random.default_rng(11)
    places = 3000.0 * np.stack(np.meshgrid(np.arange(8), np.arange(3), [0.3]), axis=-1).reshape(-1, 3)

    def tiles(spread):
        shifts = spread * rng.standard_normal((len(places), 3))
        return [Displacement(p, s, 4.0 * np.eye(3), 900, 9.0, 5.0, "kept") for p, s in zip(places, shifts, strict=True)]

    assert 2.0 < spread_factor(tiles(6.0), 3000.0) < 4.0
    assert spread_factor(tiles(0.2), 3000.0) == 1.0
    # One tile has no neighbours: what is usual.
    assert spread_factor(tiles(6.0)[:1], 3000.0) > 1.5
