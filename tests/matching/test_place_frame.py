"""A frame that is not found by itself: looked for again where its neighbours say, or left to what they say."""

from dataclasses import replace

import numpy as np
import pytest

from cosp.errors import PlacementError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records
from cosp.matching.footprint import Attempt, Footprint
from cosp.matching.placement import SearchLimits
from scripts.place_frame import place_frame

from .conftest import CRS, make_camera, moved, texture

LIMITS = SearchLimits(
    coarse_posting_m=240.0, fine_posting_m=80.0, min_score=8.0, min_margin=2.0, min_agreeing=12,
    min_agreeing_share=0.3, min_block_share=0.5, max_sigma_m=300.0,
)  # fmt: skip
CHOICES = {
    "day": None, "reference_dem_heights": "ellipsoidal", "search_km": 100, "limits": LIMITS, "seed": 1, "threads": 1,
}  # fmt: skip


PARTNER = replace(make_camera("aft"), scene="DS1104-2169DA098")


def footprint_of(camera):
    return Footprint(
        scene=camera.scene, camera=camera, shift_east_m=0.0, shift_north_m=0.0, turned=False, score=20.0, margin=9.0,
        agreeing_share=1.0, residual_m=10.0, posting_m=60.0, reference="image", sun_azimuth_deg=135.0,
        corners_lonlat=((0.0, 0.0),) * 4, blocks=(),
    )  # fmt: skip


def settle(folder, world, film, predicted, others):
    rasters.write(folder / "dem.tif", world.heights, grid=world.grid, crs=CRS)
    rasters.write(folder / "image.tif", world.image.astype(np.uint8), grid=world.grid, crs=CRS)
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1]))
    rasters.write(folder / "film.tif", pixels, grid=film.grid, crs=rasters.FILM_CRS)
    records.write(folder / "straight.json", {"turned": False, "mirrored": [False] * 4})
    records.write(folder / "camera.json", predicted)
    records.write(folder / "own.json", Attempt(predicted.scene, None, f"{predicted.scene}: cannot be placed: no peak"))
    for number, other in enumerate(others):
        records.write(folder / f"other{number}.json", other)
    place_frame(
        folder / "own.json", [folder / f"other{number}.json" for number in range(len(others))], folder / "film.tif",
        folder / "straight.json", folder / "camera.json", folder / "dem.tif", folder / "image.tif",
        folder / "footprint.json", folder / "right.tif", folder / "film.json", **CHOICES,
    )  # fmt: skip
    return records.read(folder / "footprint.json", Footprint)


@pytest.mark.slow
def test_a_frame_is_found_where_its_partner_looks(tmp_path, world, camera):
    partner = Attempt("DS1104-2169DA098", footprint_of(PARTNER), None)
    film = world.expose(camera, rng=np.random.default_rng(1))
    found = settle(tmp_path, world, film, moved(camera, 60000.0, -50000.0), [partner])
    points = np.stack(np.meshgrid(np.linspace(-195, 195, 9), np.linspace(-26, 26, 3)), -1)
    error_mm = np.linalg.norm(found.camera.project(camera.locate(points, 1000.0)) - points, axis=-1)
    assert error_mm.max() < 0.1
    assert (found.reference, found.neighbours) == ("image", ("DS1104-2169DA098",))
    assert abs(found.shift_east_m + 60000.0) < 1000.0


@pytest.mark.slow
def test_a_blank_frame_keeps_what_its_neighbours_say_and_how_little_that_is(tmp_path, world, camera):
    other_pass = Attempt("DS1104-2170DA098", footprint_of(moved(PARTNER, 9e5, 0.0)), None)
    partner = Attempt("DS1104-2169DA098", footprint_of(PARTNER), None)
    film = world.expose(camera, image=texture(world.grid.shape, np.random.default_rng(3)))
    found = settle(tmp_path, world, film, moved(camera, 60000.0, -50000.0), [other_pass, partner])
    assert found.reference == "neighbours"
    assert found.neighbours == ("DS1104-2169DA098",)
    assert 5000.0 < found.sigma_m < 12000.0
    assert abs(found.shift_east_m + 60000.0) < found.sigma_m
    assert abs(found.shift_north_m - 50000.0) < 2 * found.sigma_m


@pytest.mark.parametrize("aft", [False, True])
def test_a_film_seen_through_its_back_is_put_right_and_its_summary_says_so(tmp_path, camera, aft):
    grey = np.arange(1, 121, dtype=np.uint8).reshape(6, 20)
    rasters.write(
        tmp_path / "straight.tif", grey, grid=PixelGrid(-9.5, 2.5, 1.0, -1.0, grey.shape), crs=rasters.FILM_CRS
    )
    records.write(tmp_path / "straight.json", {"turned": aft, "mirrored": [False, True, False, False]})
    found = replace(footprint_of(camera), turned=True, mirrored=True)
    records.write(tmp_path / "own.json", Attempt(camera.scene, found, None))
    right, said = tmp_path / "film.tif", tmp_path / "film.json"
    place_frame(
        tmp_path / "own.json", [], tmp_path / "straight.tif", tmp_path / "straight.json", tmp_path / "camera.json",
        tmp_path / "dem.tif", None, tmp_path / "footprint.json", right, said, **CHOICES,
    )  # fmt: skip
    np.testing.assert_array_equal(rasters.read(right), grey[:, ::-1])
    summary = records.read_json(said)
    assert summary["turned"] is not aft
    assert summary["mirrored"] == [True, False, True, True]
    assert summary["found_on_the_ground"] == {"turned": True, "mirrored": True}


def test_a_frame_without_neighbours_is_refused_with_its_own_evidence(tmp_path, world, camera):
    film = world.expose(camera, pixel_mm=2.0)
    with pytest.raises(PlacementError, match="no peak; no other frame of its pass has been placed"):
        settle(tmp_path, world, film, camera, [Attempt("DS1104-2169DA098", None, "refused too")])
