"""Join the pairs of a site: DEMs, orthophotos and qualities in, the site's mosaic and its page out."""

import io
import logging
from collections import defaultdict
from pathlib import Path

import numpy as np

from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.dem.assessment import seen_by
from cosp.dem.blending import grey_levels, mosaic, mosaic_orthophotos
from cosp.dem.tally import Tally
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters, records, tables, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to
from cosp.report import figures
from cosp.report.film import Bending, draw_bending, draw_control, draw_y_parallax
from cosp.report.page import Picture, Section, Table, build_page, comparison, flat, picture, readable
from cosp.report.site import (
    common_grid,
    draw_tally,
    facts_table,
    library_versions,
    pair_table,
    statistics_table,
    summary_sentence,
)


def mosaic_site(
    dem_paths,
    ortho_paths,
    quality_paths,
    y_parallax_paths,
    coregistration_paths,
    figure_paths,
    film_paths,
    gcp_paths,
    gcp_summary_paths,
    seam_paths,
    adjustment_paths,
    residual_figure_paths,
    field_figure_paths,
    placement_figure_paths,
    seam_figure_paths,
    bending_figure_paths,
    camera_folders,
    reference_dem_path,
    unstable_path,
    area_path,
    dem_path,
    difference_path,
    ortho_path,
    quality_path,
    page_path,
    *,
    site,
    settings,
    pairs,
    scenes,
    blocks,
    members,
    reference_dem_heights,
    blend_m,
    slope_limit_deg,
    tile_cells,
):
    log = logging.getLogger("mosaic_site")
    infos = [rasters.info(path) for path in dem_paths]
    crs = infos[0].crs
    grid = common_grid([info.grid for info in infos])
    projectors = projectors_of_pairs(members, dict(zip(blocks, camera_folders, strict=True)), crs, grid.bounds)
    film_bounds = {
        scene: (-film["half_length_mm"], -film["half_width_mm"], film["half_length_mm"], film["half_width_mm"])
        for scene, film in zip(scenes, map(records.read_json, film_paths), strict=True)
    }

    def ground_asked(reference_m, window):
        """Cells that both films of a pair see, inside the area of interest."""
        here = grid.window(window.row0, window.row1, window.column0, window.column1)
        asked = np.zeros(here.shape, bool)
        for pair in projectors:
            sides = [seen_by(project.film, reference_m, here, film_bounds[scene]) for scene, project in pair.items()]
            asked |= np.logical_and.reduce(sides)
        return asked & vectors.rasterise(area_path, here, crs) if area_path else asked

    kept = Thinned(grid)
    tallies = {"all": Tally(), "stable": Tally()}
    options = {"shape": grid.shape, "dtype": "float32", "grid": grid, "crs": crs, "cog": True}
    heights_said = {"content": "heights above the WGS 84 ellipsoid", "unit": "metre"}
    difference_said = {"content": "site DEM minus reference DEM", "unit": "metre"}
    halo = int(np.ceil(blend_m / grid.step_x)) + 1
    with (
        rasters.create(dem_path, **options, descriptions=["height_m"], tags=heights_said) as dem,
        rasters.create(
            difference_path, **options, descriptions=["height_difference_m"], tags=difference_said
        ) as difference,
    ):
        windows = tiles(grid.shape, tile_cells)
        for done, window in enumerate(windows, 1):
            outer = window.grown(halo, grid.shape)
            models = pieces(dem_paths, infos, grid, outer, np.float32(np.nan))
            heights_m = np.full(window.shape, np.nan, np.float32)
            difference_m = heights_m
            if models:
                here = grid.window(outer.row0, outer.row1, outer.column0, outer.column1)
                inner = window.inside(outer).slices
                reference_m = ellipsoidal_heights(reference_dem_path, here, crs, reference_dem_heights)
                unstable = vectors.rasterise(unstable_path, here, crs) if unstable_path else None
                slope = slope_deg(reference_m, here.step_x, here.step_y)
                stable = stable_terrain(slope, unstable, slope_limit_deg=slope_limit_deg)
                heights_m = mosaic(list(models.values()), ramp_cells=blend_m / grid.step_x)[inner]
                difference_m = heights_m - reference_m[inner]
                asked = ground_asked(reference_m[inner], window)
                tallies["all"].add(difference_m, asked & np.isfinite(slope[inner]))
                tallies["stable"].add(difference_m, asked & stable[inner])
            dem.write(window, heights_m)
            difference.write(window, difference_m)
            kept.take(window, heights_m=heights_m, difference_m=difference_m)
            log.info("joined %d/%d tiles", done, len(windows))

    ortho_infos = [rasters.info(path) for path in ortho_paths]
    ortho_grid = common_grid([info.grid for info in ortho_infos])
    ramp_cells = blend_m / ortho_grid.step_x
    thin = Thinned(ortho_grid)
    for window in tiles(ortho_grid.shape, tile_cells):
        for path, piece in pieces(ortho_paths, ortho_infos, ortho_grid, window, np.uint8(0)).items():
            thin.take(window, **{path: piece})
    greys = [np.nan_to_num(thin.arrays[path]).astype(np.uint8) for path in ortho_paths]
    levels = dict(zip(ortho_paths, grey_levels(greys, ramp_cells=ramp_cells / thin.every), strict=True))
    options = {"shape": ortho_grid.shape, "dtype": "uint8", "grid": ortho_grid, "crs": crs, "nodata": 0, "cog": True}
    with rasters.create(ortho_path, **options) as ortho:
        for window in tiles(ortho_grid.shape, tile_cells):
            outer = window.grown(int(np.ceil(ramp_cells)) + 1, ortho_grid.shape)
            images = pieces(ortho_paths, ortho_infos, ortho_grid, outer, np.uint8(0))
            joined = np.zeros(outer.shape, np.uint8)
            if images:
                chosen = [levels[path] for path in images]
                joined = mosaic_orthophotos(list(images.values()), ramp_cells=ramp_cells, levels=chosen)
            ortho.write(window, joined[window.inside(outer).slices])
    log.info("joined %d orthophotos", len(ortho_paths))

    qualities = dict(zip(pairs, map(records.read_json, quality_paths), strict=True))
    whole = {name: tally.statistics(cell_area_m2=grid.step_x**2) for name, tally in tallies.items()}
    quality = {"kind": "site_quality", "version": 1, "site": site, "crs": crs, "mosaic": whole, "pairs": qualities}

    films = dict(zip(scenes, map(records.read_json, film_paths), strict=True))
    adjustments = dict(zip(blocks, map(records.read_json, adjustment_paths), strict=True))
    maps = (
        draw(figures.hillshade, kept.arrays["heights_m"], kept.grid, title=f"{site}: heights"),
        draw(figures.difference_map, kept.arrays["difference_m"], kept.grid, title=f"{site}: DEM minus reference DEM"),
        picture(draw_tally(tallies["stable"], title=f"{site}: differences on stable terrain"), "distribution"),
    )
    pictures = {pair: [path for path in figure_paths if Path(path).parent.name == pair] for pair in pairs}
    coregistrations = named(pairs, coregistration_paths)
    y_parallaxes = dict(zip(pairs, map(rasters.read, y_parallax_paths), strict=True))
    points = {}
    for scene, path in zip(scenes, gcp_paths, strict=True):
        gcps = tables.read(path)
        points[scene] = {role: gcps.loc[gcps["role"] == role, ["x_mm", "y_mm"]] for role in gcps["role"].unique()}
    half_width_mm = max(film["half_width_mm"] for film in films.values())
    sections = [
        Section(
            "Site",
            pictures=maps,
            tables=(
                facts_table(quality, settings),
                statistics_table(
                    "Mosaic minus reference DEM, ground that both films of a pair see",
                    {"all terrain": whole["all"], "stable terrain": whole["stable"]},
                ),
            ),
        ),
        *(
            Section(
                f"Pair {pair}",
                "Differences are ours minus the other model's, before and after coregistration.",
                pictures=tuple(Picture(Path(path).read_bytes(), caption_of(path)) for path in pictures[pair]),
                tables=(pair_table(qualities[pair]),),
                details=(
                    comparison("Everything in its quality.json", {pair: qualities[pair]}),
                    comparison("Coregistration", {pair: coregistrations[pair]}),
                ),
            )
            for pair in pairs
        ),
        Section("Epipolar geometry", pictures=(picture(draw_y_parallax(y_parallaxes), "y-parallax that is left"),)),
        Section(
            "Orientation",
            pictures=tuple(
                Picture(Path(path).read_bytes(), f"{block}: residuals of the adjustment")
                for block, path in zip(blocks, residual_figure_paths, strict=True)
            )
            + tuple(
                Picture(Path(path).read_bytes(), f"{block}: distortion of the films that the adjustment found")
                for block, path in zip(blocks, field_figure_paths, strict=True)
            ),
            tables=(comparison("Adjustment of each block", adjustments),),
        ),
        Section(
            "Ground control",
            pictures=(
                picture(draw_control(points, half_width_mm=half_width_mm), "where control lies on the films"),
                *(
                    Picture(Path(path).read_bytes(), f"{scene}: search for its place, score of every shift")
                    for scene, path in zip(scenes, placement_figure_paths, strict=True)
                ),
            ),
            details=(comparison("Control of each scene", named(scenes, gcp_summary_paths)),),
        ),
        Section(
            "Films",
            pictures=(
                picture(draw_bending([bending(*film) for film in films.items()]), "bending that was taken out"),
                *(
                    Picture(Path(path).read_bytes(), f"{scene}: {caption}")
                    for caption, paths in (
                        ("what the overlaps of its parts show", seam_figure_paths),
                        ("how straight it is, and its rail holes", bending_figure_paths),
                    )
                    for scene, path in zip(scenes, paths, strict=True)
                ),
            ),
            tables=(seam_table(named(scenes, seam_paths)),),
            details=(comparison("Everything in film.json", films),),
        ),
        Section(
            "Parameters and versions",
            details=(
                Table("Parameters", ("key", "value"), tuple((k, readable(v)) for k, v in flat(settings))),
                Table("Versions", ("package", "version"), tuple(library_versions().items())),
            ),
        ),
    ]
    records.write_text(page_path, build_page(f"Quality of site {site}", summary_sentence(quality), sections))
    records.write(quality_path, quality)


def named(names, paths):
    """Records by name."""
    return dict(zip(names, map(records.read_json, paths), strict=True))


def projectors_of_pairs(members, camera_folders, crs, bounds):
    """By scene, the map projector of both cameras of each pair."""
    return [
        {
            scene: MapProjector(records.read(f"{camera_folders[block]}/{scene}.json", PanoramicCamera), crs, bounds)
            for scene in (fore, aft)
        }
        for fore, aft, block in members
    ]


def pieces(paths, infos, grid, window, missing):
    """By path, a window of the common grid of each raster that has anything there."""
    found = {}
    for path, info in zip(paths, infos, strict=True):
        row, column = (round(float(v)) for v in grid.pixels((info.grid.x0, info.grid.y0)))
        whole = Window(row, row + info.shape[0], column, column + info.shape[1])
        part = window.common(whole)
        if min(part.shape) > 0:
            values = rasters.read(path, window=part.inside(whole))
            if (np.isfinite(values) if np.isnan(missing) else values != missing).any():
                piece = np.full(window.shape, missing)
                piece[part.inside(window).slices] = values
                found[path] = piece
    return found


class Thinned:
    """Every n-th cell of arrays that come tile by tile, as many as a picture has pixels."""

    def __init__(self, grid, longest=1600):
        self.every = max(1, -(-max(grid.shape) // longest))
        self.shape = grid.shape
        first = self.every // 2
        rows, columns = (len(range(first, n, self.every)) for n in grid.shape)
        step_x, step_y = grid.step_x * self.every, grid.step_y * self.every
        x0, y0 = (float(v) for v in grid.points(first, first))
        self.grid = PixelGrid(x0, y0, step_x, step_y, (rows, columns))
        self.arrays = defaultdict(lambda: np.full(self.grid.shape, np.nan, np.float32))

    def take(self, window, **values):
        """Keep what falls on every n-th row and column."""
        first = self.every // 2
        rows = np.arange(window.row0, window.row1)
        columns = np.arange(window.column0, window.column1)
        rows, columns = (v[v % self.every == first] for v in (rows, columns))
        if rows.size and columns.size:
            to = np.ix_((rows - first) // self.every, (columns - first) // self.every)
            for name, array in values.items():
                self.arrays[name][to] = array[np.ix_(rows - window.row0, columns - window.column0)]


def caption_of(path):
    """What a figure of a pair shows."""
    shown = {
        "hillshade": "shaded relief of the DEM after coregistration",
        "dem_difference": "DEM after coregistration minus reference DEM; red is lower than the reference, blue higher",
        "histogram": "distribution of the differences before and after coregistration",
        "disparity": "disparity of the dense matching, its confidence and similarity, on the rectified fore image",
    }
    return shown.get(Path(path).stem, Path(path).stem)


def draw(function, *values, title):
    """What a map function draws, as a picture of the page."""
    buffer = io.BytesIO()
    function(buffer, *values, title=title)
    return Picture(buffer.getvalue(), title)


def bending(scene, film):
    """Curves of a film's record."""
    found = film["bending"]
    return Bending(scene, found["source"], *(np.array(found[k], float) for k in ("x_mm", "dy_top_mm", "dy_bottom_mm")))


def seam_table(by_scene):
    """Seams of all films, one a row."""
    shown = ("left", "right", "rotation_deg", "overlap_mm", "inliers", "rms_px", "check_rms_px")
    rows = tuple((scene, *(seam.get(k) for k in shown)) for scene, each in by_scene.items() for seam in each["seams"])
    return Table("Seams", ("scene", *shown), rows)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        mosaic_site(
            dem_paths=list(snakemake.input.dems),
            ortho_paths=list(snakemake.input.orthos),
            quality_paths=list(snakemake.input.qualities),
            y_parallax_paths=list(snakemake.input.y_parallaxes),
            coregistration_paths=list(snakemake.input.coregistrations),
            figure_paths=list(snakemake.input.figures),
            film_paths=list(snakemake.input.films),
            gcp_paths=list(snakemake.input.gcps),
            gcp_summary_paths=list(snakemake.input.gcp_summaries),
            seam_paths=list(snakemake.input.seams),
            adjustment_paths=list(snakemake.input.adjustments),
            residual_figure_paths=list(snakemake.input.residual_figures),
            field_figure_paths=list(snakemake.input.field_figures),
            placement_figure_paths=list(snakemake.input.placement_figures),
            seam_figure_paths=list(snakemake.input.seam_figures),
            bending_figure_paths=list(snakemake.input.bending_figures),
            camera_folders=list(snakemake.input.cameras),
            area_path=snakemake.input.area_of_interest or None,
            reference_dem_path=snakemake.input.reference_dem,
            unstable_path=snakemake.input.unstable_terrain or None,
            dem_path=snakemake.output.dem,
            difference_path=snakemake.output.difference,
            ortho_path=snakemake.output.ortho,
            quality_path=snakemake.output.quality,
            page_path=snakemake.output.page,
            site=snakemake.wildcards.site,
            settings=snakemake.params.settings,
            pairs=snakemake.params.pairs,
            scenes=snakemake.params.scenes,
            blocks=snakemake.params.blocks,
            members=snakemake.params.members,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            blend_m=snakemake.params.blend_m,
            slope_limit_deg=snakemake.params.slope_limit_deg,
            tile_cells=snakemake.params.tile_cells,
        )
