"""A small world with a textured map and hills, and films of it exposed through a known camera."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import MapFrame
from cosp.imaging.resampling import sample
from cosp.matching.film_image import FilmImage

CRS = "EPSG:32632"
FILM_PIXEL_MM = 0.28


def make_camera(look="fore", *, half_length_mm=200.0):
    sense = -1.0 if look == "fore" else 1.0
    return PanoramicCamera(
        scene=f"DS1104-2169D{look[0].upper()}092",
        focal_length_mm=609.6,
        half_length_mm=half_length_mm,
        half_width_mm=27.7,
        scan_direction=1 if look == "fore" else -1,
        origin=LocalFrame(9.0, 46.0, 0.0),
        position_m=(0.0, -sense * 45000.0, 165000.0),
        position_change_m=(-300.0, -2700.0, 0.0),
        angles_deg=(sense * 15.0, 0.5, 2.0),
        angles_change_deg=(0.9, 0.0, 0.05),
        imc_factor=0.0,
    )


def texture(shape, rng, sigmas=(1.0, 3.0, 9.0)):
    """Grey values with structure at several sizes, about 40 to 220."""
    image = sum(s * gaussian_filter(rng.standard_normal(shape), s, mode="wrap") for s in sigmas)
    return (130 + 30 * image / image.std()).clip(20, 240).astype(np.float32)


@dataclass
class World:
    grid: PixelGrid
    image: np.ndarray
    heights: np.ndarray

    def on(self, raster):
        """A function that gives a raster of this world on any grid, NaN outside."""

        smoothed = {}

        def on_grid(grid):
            rows, columns = self.grid.pixels(grid.centres())
            inside = (
                (rows >= 0) & (rows <= self.grid.shape[0] - 1) & (columns >= 0) & (columns <= self.grid.shape[1] - 1)
            )
            step = grid.step_x / self.grid.step_x
            if step not in smoothed:  # finer than the grid, as a warp with averaging would leave it
                smoothed[step] = gaussian_filter(raster.astype(np.float32), step / 2.5 if step > 1.5 else 0.0)
            values = sample(smoothed[step], rows, columns, interpolation="linear")
            return np.where(inside, values, np.nan).astype(np.float32)

        return on_grid

    def expose(self, camera, *, noise=6.0, rng=None, image=None, pixel_mm=FILM_PIXEL_MM):
        """Film of this world: grey values at the ground that each pixel's ray meets."""
        columns, rows = round(2 * camera.half_length_mm / pixel_mm), round(2 * camera.half_width_mm / pixel_mm)
        grid = PixelGrid(-(columns - 1) / 2 * pixel_mm, (rows - 1) / 2 * pixel_mm, pixel_mm, -pixel_mm, (rows, columns))
        frame = MapFrame(camera.origin, CRS, self.grid.bounds)

        def height_at(lonlat):
            points = frame.map_from_geodetic(np.concatenate([lonlat, np.zeros((*lonlat.shape[:-1], 1))], axis=-1))
            r, c = self.grid.pixels(points[..., :2])
            r, c = np.clip(r, 0, self.grid.shape[0] - 1), np.clip(c, 0, self.grid.shape[1] - 1)
            return sample(self.heights, r, c, interpolation="linear").astype(float)

        ground = camera.locate_on(grid.centres(), height_at, iterations=3)
        points = frame.map_from_geodetic(camera.origin.geodetic_from_local(ground))
        r, c = self.grid.pixels(points[..., :2])
        source = self.image if image is None else image
        grey = sample(source, r, c, interpolation="linear", border=0)
        inside = grey > 0
        if rng is not None:
            grey = grey + noise * rng.standard_normal(grey.shape)
        return FilmImage.from_array(np.where(inside, np.clip(grey, 1, 255), 0).astype(np.uint8), grid)


def make_world(rng, bounds, posting):
    grid = PixelGrid.covering(bounds, posting)
    smooth = gaussian_filter(rng.standard_normal(grid.shape), 3000.0 / posting, mode="wrap")
    heights = (900 + 350 * smooth / smooth.std()).clip(0, 4000).astype(np.float32)
    return World(grid, texture(grid.shape, rng), heights)


def moved(camera, east_m, north_m):
    """The camera carried over the ellipsoid."""
    latitude = camera.origin.latitude_deg
    return replace(
        camera,
        origin=LocalFrame(
            float(camera.origin.longitude_deg + east_m / (111320 * np.cos(np.radians(latitude)))),
            latitude + north_m / 111180,
        ),
    ).moved_to(camera.origin)


@pytest.fixture(scope="session")
def camera():
    return make_camera()


@pytest.fixture(scope="session")
def world(camera):
    from cosp.matching.ground import grown, map_bounds

    return make_world(np.random.default_rng(5), grown(map_bounds(camera, CRS, (0.0, 2500.0)), 20000.0), 90.0)
