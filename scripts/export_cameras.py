"""Write the adjusted cameras of a block, and the images they go with, in forms that other programs read."""

import dataclasses
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from cosp.camera import location_grid, opticalbar, rpc
from cosp.camera.exits import Residual, film_lattice
from cosp.camera.ideal_film import measured_window, without_field
from cosp.camera.panoramic import PanoramicCamera
from cosp.camera.tsai import tsai_text
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window, tiles, worked_on
from cosp.io import rasters, records, views
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to

GEODETIC = "EPSG:4326"
TERRAIN_STEP_DEG = 1 / 360  # ten seconds: fine enough for the range of heights
TILE_PX = 1024


def export_cameras(
    cameras_folder,
    film_paths,
    reference_dem_path,
    exports_folder,
    *,
    scenes,
    reference_dem_heights,
    formats,
    height_margin_m,
    rpc_pieces,
    rpc_largest_px,
    grid_step_mm,
    grid_height_step_m,
    threads,
):
    log = logging.getLogger("export_cameras")
    folder = Path(exports_folder)
    summary = {}
    for scene, film_path in zip(scenes, film_paths, strict=True):
        measured = records.read(Path(cameras_folder) / f"{scene}.json", PanoramicCamera)
        camera = measured.without_field()
        grid = rasters.info(film_path).grid
        heights_m = terrain_range(camera, grid, reference_dem_path, reference_dem_heights, height_margin_m)
        image_path = write_image(folder / scene, film_path, grid, measured.film_field, threads)
        written = {}
        if "optical_bar" in formats:
            written["optical_bar"] = write_optical_bar(folder / scene, camera, grid, heights_m)
        if "rpc" in formats:
            shown_path = film_path if measured.film_field is None else image_path
            written["rpc"] = write_rpcs(folder / scene, shown_path, camera, grid, heights_m, rpc_pieces, rpc_largest_px)
        if "location_grid" in formats:
            written["location_grid"] = write_location_grid(
                folder / scene, camera, grid, heights_m, grid_step_mm, grid_height_step_m
            )
        for files in written.values():
            for file in files:
                log.info("%s: %.4f px rms, %.4f px at most", file["file"], file["rms_px"], file["largest_px"])
        summary[scene] = {
            "image": image_path.name,
            "film_field_removed": measured.film_field is not None,
            "heights_m": heights_m,
            **written,
        }
    records.write(folder / "exports.json", {"kind": "exports", "version": 1, "scenes": summary})


def terrain_range(camera, grid, reference_dem_path, reference_dem_heights, margin_m):
    """Lowest and highest ellipsoidal height of the reference DEM about a film, with a margin."""
    film_mm, _ = film_lattice(grid, (0.0, 1.0), (31, 5, 2))
    lonlat = camera.locate_geodetic(film_mm, 0.0)[:, :2]
    terrain_grid = PixelGrid.covering((*lonlat.min(axis=0), *lonlat.max(axis=0)), TERRAIN_STEP_DEG)
    terrain_m = ellipsoidal_heights(reference_dem_path, terrain_grid, GEODETIC, reference_dem_heights)
    if np.isnan(terrain_m).all():
        raise NoOverlapError(f"{camera.scene}: the reference DEM {reference_dem_path} has no height under the film")
    return float(np.floor(np.nanmin(terrain_m) - margin_m)), float(np.ceil(np.nanmax(terrain_m) + margin_m))


def write_image(stem, film_path, grid, field, threads):
    """The image that the exported cameras go with, its pixels counted from the corner.

    A view of the film or, where distortion is known, the film resampled so that it is gone.
    """
    if field is None:
        path = stem.with_suffix(".vrt")
        views.write(path, film_path, Window(0, grid.shape[0], 0, grid.shape[1]))
        return path
    path = stem.with_suffix(".tif")
    windows = tiles(grid.shape, TILE_PX)

    def ideal(window):
        return without_field(field, grid, window, rasters.read(film_path, window=measured_window(field, grid, window)))

    with (
        rasters.create(
            path, shape=grid.shape, dtype="uint8", grid=PixelGrid(0.5, 0.5, 1.0, 1.0, grid.shape), crs=None, nodata=0
        ) as image,
        ThreadPoolExecutor(threads) as pool,
    ):
        for window, values in worked_on(pool, ideal, windows, ahead=threads):
            image.write(window, values)
    return path


def write_optical_bar(stem, camera, grid, heights_m):
    path = stem.with_suffix(".tsai")
    bar = opticalbar.optical_bar_from_panoramic(camera, grid, heights_m=heights_m)
    records.write_text(path, tsai_text(bar))
    film_mm, height_m = film_lattice(grid, heights_m)
    left_mm = opticalbar.residuals_mm(bar, camera, film_mm, camera.locate(film_mm, height_m))
    return [entry(path, Residual.of(left_mm / grid.step_x))]


def write_rpcs(stem, image_path, camera, grid, heights_m, pieces, largest_px):
    files = []
    found = rpc.fit_pieces(camera, grid, heights_m=heights_m, pieces=pieces, largest_px=largest_px)
    for number, (window, coefficients, residual) in enumerate(found, 1):
        path = stem.with_name(f"{stem.name}_{number}.vrt")
        views.write(path, image_path, window, metadata={"RPC": coefficients.metadata()})
        records.write_text(path.with_name(f"{path.stem}_RPC.TXT"), coefficients.text())
        files.append({**entry(path, residual), "columns": [window.column0, window.column1]})
    return files


def write_location_grid(stem, camera, grid, heights_m, step_mm, height_step_m):
    path = stem.with_name(f"{stem.name}_grid.tif")
    located = location_grid.location_grid(
        camera, grid, heights_m=heights_m, step_mm=step_mm, height_step_m=height_step_m
    )
    columns, rows = located.step_px
    nodes = PixelGrid(columns / 2, rows / 2, columns, rows, located.lonlat_deg.shape[2:])
    rasters.write(path, located.bands(), grid=nodes, tags=located.tags())
    residuals = location_grid.residuals_px(located, camera, grid, *film_lattice(grid, heights_m))
    return [entry(path, Residual.of(residuals))]


def entry(path, residual):
    return {"file": path.name, **dataclasses.asdict(residual)}


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        export_cameras(
            cameras_folder=snakemake.input.cameras,
            film_paths=list(snakemake.input.films),
            reference_dem_path=snakemake.input.reference_dem,
            exports_folder=snakemake.output.exports,
            scenes=snakemake.params.scenes,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            formats=snakemake.params.formats,
            height_margin_m=snakemake.params.height_margin_m,
            rpc_pieces=snakemake.params.rpc_pieces,
            rpc_largest_px=snakemake.params.rpc_largest_px,
            grid_step_mm=snakemake.params.grid_step_mm,
            grid_height_step_m=snakemake.params.grid_height_step_m,
            threads=snakemake.threads,
        )
