"""The three scripts in a row, as the workflow runs them, on a coarse film with known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosp.film.bending import Bending
from cosp.film.exposure import Exposure
from cosp.film.joining import Layout, compose
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records
from cosp.simulation.site import SiteSettings
from tests.benchmarks.film import SCENE, run_stages
from tests.film.delivered import Delivered, Wishes, deliver, errors

PIXEL_UM = 140.0


def _written(path: Path, image: np.ndarray) -> str:
    rasters.write(path, image, grid=PixelGrid(0.5, 0.5, 1.0, 1.0, image.shape))
    return str(path)


@pytest.fixture(scope="module")
def film() -> Delivered:
    settings = SiteSettings(seed=3, pixel_um=PIXEL_UM, overlap_mm=30.0, part_rotation_deg=0.5, bending_mm=0.8)
    return deliver(settings, "aft", Wishes(order=(3, 2, 1, 0), stripe_gaps=0.5))


@pytest.fixture(scope="module")
def folder(film: Delivered, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Products of the three scripts."""
    place = tmp_path_factory.mktemp("film")
    parts = [_written(place / f"{SCENE}_{k}.tif", image) for k, image in zip("abcd", film.by_letter(), strict=True)]
    run_stages(parts, place, camera="KH-4B", look="aft", pixel_um=PIXEL_UM, threads=2)
    return place


@pytest.mark.slow
def test_a_film_in_parts_comes_out_straight_and_where_it_should(film: Delivered, folder: Path) -> None:
    seams, summary = (records.read_json(folder / name) for name in ("seams.json", "film.json"))
    layout = records.from_plain(seams["layout"], Layout, "layout")
    bending = records.from_plain(summary["bending"], Bending, "bending")
    exposure = records.from_plain(summary["exposure"], Exposure, "exposure")
    found = errors(film, seams, layout, exposure, bending, summary["turned"])
    assert summary["turned"]
    assert summary["part_order"] == [f"{SCENE}_{k}" for k in "dcba"]
    assert found.seam_px.max() < 0.1
    assert bending.source == "stripes"
    # The truth was bent by 0.4 mm rms.
    assert found.straightness_um < 0.3 * PIXEL_UM
    assert abs(found.scale_ppm) < 100
    for error, sd in zip(found.centre_mm, summary["centre_sd_mm"], strict=True):
        assert abs(error) < max(4 * sd, 0.5 * PIXEL_UM / 1000)
    assert [holes["count"] > 60 for holes in summary["rail_holes"]] == [True, True]
    assert all(holes["deviation_nmad_mm"] < 0.3 * PIXEL_UM / 1000 for holes in summary["rail_holes"])
    assert not any(seam["steps"] for seam in seams["seams"])
    assert all((folder / name).stat().st_size > 1000 for name in ("seams.png", "bending.png"))


@pytest.mark.slow
def test_a_film_that_comes_joined_passes_through_to_the_same_film(
    film: Delivered, folder: Path, tmp_path: Path
) -> None:
    seams = records.read_json(folder / "seams.json")
    layout = records.from_plain(seams["layout"], Layout, "layout")
    parts = [film.parts[film.wishes.order["abcd".index(name[-1])]] for name in seams["part_order"]]
    whole = compose(parts, layout, Window(0, layout.shape[0], 0, layout.shape[1]))
    run_stages(
        [_written(tmp_path / f"{SCENE}.tif", whole)],
        tmp_path,
        camera="KH-4B",
        look="aft",
        pixel_um=PIXEL_UM,
        threads=1,
    )
    assert records.read_json(tmp_path / "seams.json")["seams"] == []
    once, twice = (rasters.read(place / "film.tif").astype(float) for place in (folder, tmp_path))
    assert once.shape == twice.shape
    # Resampled twice it is smoother, but it lies where it did.
    assert np.corrcoef(once[20:-20, 200:-200].ravel(), twice[20:-20, 200:-200].ravel())[0, 1] > 0.97
