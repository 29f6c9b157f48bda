"""Real stereo images with rational polynomials for cameras pass through epipolar, dense and surface as films do."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import pytest
import rasterio
from rasterio.rpc import RPC

from cosp.dense.coarse_to_fine import match
from cosp.dense.resampling import SmoothField
from cosp.epipolar.correspondences import FilmMapping, virtual_conjugates
from cosp.epipolar.parallax import fold_y_parallax, measure_y_parallax, node_grid
from cosp.epipolar.patches import film_patches, image_patches
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.epipolar.resampling import resample_window
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import MapFrame
from cosp.geometry.rays import Rays
from cosp.geometry.statistics import nmad
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window
from cosp.surface.gridding import grid_points
from cosp.surface.intersection import PixelIntersection
from tests.surface.synthetic import LARGEST_ERROR_RAD

GEOID_M = 50.4  # of EGM96 near Mont Ventoux above the ellipsoid
_log = logging.getLogger(__name__)

Y_PARALLAX = {
    "template_px": 32,
    "least_score": 0.6,
    "largest_ratio": 0.85,
    "smoothing_nodes": 2.0,
    "fewest_matches": 30,
    "threads": 1,
}
DENSE = {
    "small_step": 24,
    "large_step": 64,
    "least_texture_sd": 2.0,
    "saturated_from": 256,
    "least_correlation": 0.35,
    "least_uniqueness": 0.25,
    "largest_speckle_px": 100,
    "speckle_step_px": 1.5,
    "threads": 1,
}


@dataclass(frozen=True)
class RationalCamera:
    """An image with rational polynomials; its "film" is in pixels from its middle, y upwards."""

    grey: np.ndarray
    rpc: RPC
    corner: tuple[float, float]  # row and column of the image's first pixel where the polynomials count
    frame: LocalFrame

    @property
    def grid(self):
        rows, columns = self.grey.shape
        return PixelGrid(-(columns - 1) / 2, (rows - 1) / 2, 1.0, -1.0, self.grey.shape)

    def project_geodetic(self, lonlath):
        """Film points (..., 2) of longitude, latitude, height; RPC00B."""
        r = self.rpc
        p = (lonlath[..., 1] - r.lat_off) / r.lat_scale
        q = (lonlath[..., 0] - r.long_off) / r.long_scale
        h = (lonlath[..., 2] - r.height_off) / r.height_scale
        terms = np.stack(
            [p**0, q, p, h, q * p, q * h, p * h, q * q, p * p, h * h]
            + [p * q * h, q**3, q * p * p, q * h * h, q * q * p, p**3, p * h * h, q * q * h, p * p * h, h**3],
            axis=-1,
        )
        row, column = (
            (terms @ np.array(numerator)) / (terms @ np.array(denominator)) * scale + offset - first
            for numerator, denominator, scale, offset, first in (
                (r.line_num_coeff, r.line_den_coeff, r.line_scale, r.line_off, self.corner[0]),
                (r.samp_num_coeff, r.samp_den_coeff, r.samp_scale, r.samp_off, self.corner[1]),
            )
        )
        return self.grid.points(row, column)

    def project(self, ground_m):
        return self.project_geodetic(self.frame.geodetic_from_local(ground_m))

    def locate(self, film, height_m):
        """Local ground points of film points at ellipsoidal heights, by Newton steps on the map."""
        film, height = np.asarray(film, float), np.broadcast_to(np.asarray(height_m, float), np.shape(film)[:-1])
        place = np.stack(
            [np.full(height.shape, self.frame.longitude_deg), np.full(height.shape, self.frame.latitude_deg), height],
            -1,
        )
        step = 1e-5
        for _ in range(8):
            here = self.project_geodetic(place)
            east = (self.project_geodetic(place + [step, 0, 0]) - here) / step
            north = (self.project_geodetic(place + [0, step, 0]) - here) / step
            jacobian = np.stack([east, north], axis=-1)
            place[..., :2] += np.linalg.solve(jacobian, (film - here)[..., None])[..., 0]
        return self.frame.local_from_geodetic(place)

    def rays(self, film):
        high, low = self.locate(film, 1500.0), self.locate(film, 0.0)
        direction = low - high
        return Rays(high, direction / np.linalg.norm(direction, axis=-1, keepdims=True))

    def mapping(self):
        rows, columns = self.grey.shape
        return FilmMapping(self.locate, self.project, columns / 2, rows / 2)

    def read(self, window):
        return self.grey[window.slices]


def bytes_of(images):
    """8 bit from 12, stretched alike; nothing but what is outside stays 0."""
    low, high = np.percentile(np.concatenate([image.ravel() for image in images]), [0.2, 99.8])
    return [np.clip(np.rint(1 + (image - low) / (high - low) * 254), 1, 255).astype(np.uint8) for image in images]


def points_of_pair(fore, aft, heights_m):
    """Ground points of every matched pixel, the gap of their rays, and what y-parallax was left before and after."""
    films = (fore.mapping(), aft.mapping())
    rectification = fit_rectification(
        virtual_conjugates(*films, np.linspace(*heights_m, 4)),
        films,
        pixel_mm=1.0,
        basis=Basis(3, 3),
        disparity_margin_px=8.0,
    )
    assert rectification.model_largest_px < 0.01
    nodes = node_grid(rectification.shape, spacing_px=32, fewest_nodes=400)
    centres = nodes.centres()
    bounds = rectification.disparity_bounds(centres[..., 1], centres[..., 0])
    before = measure_y_parallax(
        film_patches(fore.read, fore.grid, rectification.fore),
        film_patches(aft.read, aft.grid, rectification.aft),
        nodes,
        bounds,
        **Y_PARALLAX,
    )
    rectification = fold_y_parallax(rectification, before, smoothing_nodes=Y_PARALLAX["smoothing_nodes"])
    whole = Window(0, rectification.shape[0], 0, rectification.shape[1])
    images = [
        resample_window(camera.read, camera.grid, film, whole, interpolation="cubic")
        for camera, film in ((fore, rectification.fore), (aft, rectification.aft))
    ]
    after = measure_y_parallax(
        *(image_patches(lambda window, image=image: image[window.slices], image.shape) for image in images),
        nodes,
        bounds,
        **Y_PARALLAX,
    )
    field = SmoothField(after.smooth_px.astype(np.float32), nodes.y0, nodes.x0, nodes.step_y, nodes.step_x)
    found = match(*images, rectification.disparity_range_px, y_parallax=field, **DENSE)
    # Here nothing but the correction of the rows is said about y-parallax.
    none = np.zeros(nodes.shape, np.float32)
    pixels = PixelIntersection.prepare(
        rectification, fore.rays, aft.rays, none, nodes, spacing_px=8.0, largest_error_rad=LARGEST_ERROR_RAD
    )
    ground, gap_m = pixels.ground(whole, found.disparity)
    return ground, gap_m, before.summary(), after.summary()


def heights_of(ground, crs, frame, grid, *, point_sigma_m):
    to_map = MapFrame(frame, crs, grid.bounds)
    points = to_map.map_from_local(ground[np.isfinite(ground).all(-1)])
    return grid_points(
        points, grid, kernel_cells=0.5, gate_sigmas=5.0, point_sigma_m=point_sigma_m, points_per_independent=4.0
    )


@pytest.mark.slow
def test_a_satellite_triplet_agrees_with_the_surface_model_made_of_it(real_data):
    folder = real_data / "marseille"
    if not folder.is_dir():
        pytest.skip("no real data here: marseille is missing")
    frame = LocalFrame(5.443, 43.262)
    raw, rpcs = [], []
    for number in (1, 2, 3):
        with rasterio.open(folder / f"img_0{number}.tif") as dataset:
            raw.append(dataset.read(1))
            rpcs.append(dataset.rpcs)
    cameras = [RationalCamera(grey, rpc, (0.0, 0.0), frame) for grey, rpc in zip(bytes_of(raw), rpcs, strict=True)]
    with rasterio.open(folder / "s2p_dsm_0.5m.tif") as dataset:
        truth, transform, crs = dataset.read(1), dataset.transform, dataset.crs.to_string()
    reference = PixelGrid(transform.c + 0.25, transform.f - 0.25, 0.5, -0.5, truth.shape)

    everything = []
    for fore, aft in ((0, 1), (1, 2), (0, 2)):
        ground, gap_m, before, after = points_of_pair(cameras[fore], cameras[aft], (20.0, 340.0))
        _log.info("pair %d %d: before %s after %s", fore, aft, before, after)
        assert after["nmad_px"] < 0.3
        assert np.nanmedian(gap_m) == pytest.approx(abs(before["median_px"]) * 0.5, rel=0.3)
        everything.append(ground[np.isfinite(ground).all(-1)])
    grid = PixelGrid.covering(reference.bounds, 1.0)
    found = heights_of(np.concatenate(everything), crs, frame, grid, point_sigma_m=0.5)
    at = sample(found.height_m, *grid.pixels(reference.centres()), interpolation="nearest", border=np.nan)
    covered = np.isfinite(truth)
    difference = (at - truth)[covered]
    known = np.isfinite(difference)
    _log.info(
        "NMAD %.2f m, median %.2f m, completeness %.3f",
        nmad(difference[known]),
        np.median(difference[known]),
        known.mean(),
    )
    assert covered.sum() > 400_000
    assert known.mean() > 0.95
    assert nmad(difference[known]) < 1.0
    assert abs(np.median(difference[known])) < 0.5


@pytest.mark.slow
def test_a_satellite_pair_agrees_with_a_coarse_elevation_model(real_data):
    folder = real_data / "ventoux"
    if not folder.is_dir():
        pytest.skip("no real data here: ventoux is missing")
    frame = LocalFrame(5.19, 44.21)
    raw, rpcs, corners = [], [], []
    for side in ("left", "right"):
        with rasterio.open(folder / f"{side}_image.tif") as dataset:
            raw.append(dataset.read(1))
            corners.append((dataset.transform.f, dataset.transform.c))
        rpcs.append(rpc_of_text((folder / f"{side}_image.geom").read_text()))
    cameras = [
        RationalCamera(grey, rpc, corner, frame) for grey, rpc, corner in zip(bytes_of(raw), rpcs, corners, strict=True)
    ]
    # The crops share 170 lines of 500. Nobody has adjusted them: the first of these is the error of their polynomials.
    ground, gap_m, before, after = points_of_pair(*cameras, (450.0, 650.0))
    _log.info("before %s after %s", before, after)
    assert abs(before["median_px"]) > 1.0
    assert abs(after["median_px"]) < 0.1
    assert after["nmad_px"] < 0.3
    # The rows were corrected, the film points were not: rays still miss by what the polynomials are wrong.
    assert np.nanmedian(gap_m) == pytest.approx(abs(before["median_px"]) * 0.5, rel=0.3)
    lonlath = frame.geodetic_from_local(ground[np.isfinite(ground).all(-1)])
    with rasterio.open(folder / "N44E005.hgt") as dataset:
        terrain, transform = dataset.read(1).astype(np.float32), dataset.transform
    grid = PixelGrid(
        transform.c + transform.a / 2, transform.f + transform.e / 2, transform.a, transform.e, terrain.shape
    )
    expected = sample(terrain, *grid.pixels(lonlath[:, :2]), interpolation="linear", border=np.nan)
    difference = lonlath[:, 2] - expected - GEOID_M
    _log.info("%d points, median %.2f m, NMAD %.2f m", len(lonlath), np.median(difference), nmad(difference))
    assert len(lonlath) > 40_000
    assert abs(np.median(difference)) < 10.0
    assert nmad(difference) < 13.0  # of SRTM itself, at 90 m, in a wood


def rpc_of_text(text):
    """RPC of "key: value" lines."""
    values = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    numbers = {name.strip(): value.strip() for name, value in values.items()}

    def twenty(name):
        return [float(numbers[f"{name}_{i:02d}"]) for i in range(20)]

    return RPC(
        **{
            name: float(numbers[name])
            for name in (
                "height_off",
                "height_scale",
                "lat_off",
                "lat_scale",
                "long_off",
                "long_scale",
                "line_off",
                "line_scale",
                "samp_off",
                "samp_scale",
            )
        },
        line_num_coeff=twenty("line_num_coeff"),
        line_den_coeff=twenty("line_den_coeff"),
        samp_num_coeff=twenty("samp_num_coeff"),
        samp_den_coeff=twenty("samp_den_coeff"),
        err_bias=None,
        err_rand=None,
    )
