"""Join the pairs of a site: DEMs, orthophotos and qualities in, the site's mosaic and its page out."""

import io
import logging
from pathlib import Path

import numpy as np

from cosp.dem.blending import mosaic, mosaic_orthophotos
from cosp.dem.differencing import difference_statistics
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.imaging.windows import Window
from cosp.io import rasters, records, tables, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to
from cosp.report import figures
from cosp.report.film import Bending, draw_bending, draw_control, draw_y_parallax
from cosp.report.page import Picture, Section, Table, build_page, comparison, flat, picture, readable
from cosp.report.site import common_grid, library_versions, summary_sentence


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
    reference_dem_path,
    unstable_path,
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
    reference_dem_heights,
    blend_m,
    slope_limit_deg,
    strip_rows,
):
    log = logging.getLogger("mosaic_site")
    infos = [rasters.info(path) for path in dem_paths]
    crs = infos[0].crs
    grid = common_grid([info.grid for info in infos])
    halo = int(np.ceil(blend_m / grid.step_x)) + 1

    def strip(path, info, rows, missing):
        """Rows of a raster on the common grid."""
        part = np.full((rows[1] - rows[0], grid.shape[1]), missing)
        row0, column0 = (int(round(float(v))) for v in grid.pixels((info.grid.x0, info.grid.y0)))
        first, last = max(rows[0], row0), min(rows[1], row0 + info.shape[0])
        if first < last:
            window = Window(first - row0, last - row0, 0, info.shape[1])
            values = rasters.read(path, window=window)
            part[first - rows[0] : last - rows[0], column0 : column0 + info.shape[1]] = values
        return part

    tags = {"content": "heights above the WGS 84 ellipsoid", "unit": "metre"}
    options = {"shape": grid.shape, "dtype": "float32", "grid": grid, "crs": crs, "cog": True}
    slopes = np.empty(grid.shape, np.float32)
    difference_m = np.empty(grid.shape, np.float32)
    heights_m = np.empty(grid.shape, np.float32)
    with rasters.create(dem_path, **options, descriptions=["height_m"], tags=tags) as dem:
        for row in range(0, grid.shape[0], strip_rows):
            inner = row, min(row + strip_rows, grid.shape[0])
            outer = max(row - halo, 0), min(inner[1] + halo, grid.shape[0])
            models = [strip(p, i, outer, np.float32(np.nan)) for p, i in zip(dem_paths, infos, strict=True)]
            joined = mosaic(models, ramp_cells=blend_m / grid.step_x)
            reference_m = ellipsoidal_heights(
                reference_dem_path, grid.window(*outer, 0, grid.shape[1]), crs, reference_dem_heights
            )
            slope = slope_deg(reference_m, grid.step_x, grid.step_y)
            kept = slice(inner[0] - outer[0], inner[1] - outer[0])
            heights_m[inner[0] : inner[1]] = joined[kept]
            difference_m[inner[0] : inner[1]] = (joined - reference_m)[kept]
            slopes[inner[0] : inner[1]] = slope[kept]
            dem.write(Window(*inner, 0, grid.shape[1]), joined[kept])
            log.info("joined %d/%d rows", inner[1], grid.shape[0])
    tags = {"content": "site DEM minus reference DEM", "unit": "metre"}
    with rasters.create(difference_path, **options, descriptions=["height_difference_m"], tags=tags) as difference:
        difference.write(None, difference_m)

    ortho_infos = [rasters.info(path) for path in ortho_paths]
    ortho_grid = common_grid([info.grid for info in ortho_infos])
    images = []
    for path, info in zip(ortho_paths, ortho_infos, strict=True):
        image = np.zeros(ortho_grid.shape, np.uint8)
        row, column = (int(round(float(v))) for v in ortho_grid.pixels((info.grid.x0, info.grid.y0)))
        image[row : row + info.shape[0], column : column + info.shape[1]] = rasters.read(path)
        images.append(image)
    joined = mosaic_orthophotos(images, ramp_cells=blend_m / ortho_grid.step_x)
    rasters.write(ortho_path, joined, grid=ortho_grid, crs=crs, nodata=0, cog=True)

    unstable = vectors.rasterise(unstable_path, grid, crs) if unstable_path else None
    stable = stable_terrain(slopes, unstable, slope_limit_deg=slope_limit_deg)
    qualities = dict(zip(pairs, map(records.read_json, quality_paths), strict=True))
    whole = {
        "all": difference_statistics(difference_m, np.isfinite(slopes), cell_area_m2=grid.step_x**2),
        "stable": difference_statistics(difference_m, stable, cell_area_m2=grid.step_x**2),
    }
    quality = {"kind": "site_quality", "version": 1, "site": site, "crs": crs, "mosaic": whole, "pairs": qualities}

    films = dict(zip(scenes, map(records.read_json, film_paths), strict=True))
    adjustments = dict(zip(blocks, map(records.read_json, adjustment_paths), strict=True))
    maps = [draw(figures.hillshade, heights_m, grid, title=f"{site}: heights")]
    maps += [draw(figures.difference_map, difference_m, grid, title=f"{site}: DEM minus reference DEM")]
    stable_difference = np.where(stable, difference_m, np.nan)
    maps += [draw(figures.histogram, {"stable terrain": stable_difference}, title=f"{site}: differences")]
    pictures = [
        Picture(Path(path).read_bytes(), f"{Path(path).parent.name}: {Path(path).stem}") for path in figure_paths
    ]
    y_parallaxes = dict(zip(pairs, map(rasters.read, y_parallax_paths), strict=True))
    points = {}
    for scene, path in zip(scenes, gcp_paths, strict=True):
        gcps = tables.read(path)
        points[scene] = {role: gcps.loc[gcps["role"] == role, ["x_mm", "y_mm"]] for role in gcps["role"].unique()}
    half_width_mm = max(film["half_width_mm"] for film in films.values())
    sections = [
        Section("Site", pictures=tuple(maps), tables=(comparison("Mosaic minus reference DEM", {site: whole}),)),
        Section(
            "Pairs",
            "Differences are ours minus reference, before and after coregistration, on stable terrain both films see.",
            pictures=tuple(pictures),
            tables=(
                comparison("Quality of each pair", qualities),
                comparison("Coregistration", named(pairs, coregistration_paths)),
            ),
        ),
        Section("Epipolar geometry", pictures=(picture(draw_y_parallax(y_parallaxes), "y-parallax that is left"),)),
        Section(
            "Orientation",
            pictures=tuple(
                Picture(Path(path).read_bytes(), f"{block}: residuals of the adjustment")
                for block, path in zip(blocks, residual_figure_paths, strict=True)
            ),
            tables=(comparison("Adjustment of each block", adjustments),),
        ),
        Section(
            "Ground control",
            pictures=(picture(draw_control(points, half_width_mm=half_width_mm), "where control lies on the films"),),
            tables=(comparison("Control of each scene", named(scenes, gcp_summary_paths)),),
        ),
        Section(
            "Films",
            pictures=(picture(draw_bending([bending(*film) for film in films.items()]), "bending that was taken out"),),
            tables=(
                comparison("Films", films),
                seam_table(named(scenes, seam_paths)),
            ),
        ),
        Section(
            "Parameters and versions",
            tables=(
                Table("Parameters", ("key", "value"), tuple((k, readable(v)) for k, v in flat(settings))),
                Table("Versions", ("package", "version"), tuple(library_versions().items())),
            ),
        ),
    ]
    write_text(page_path, build_page(f"Quality of site {site}", summary_sentence(quality), sections))
    records.write(quality_path, quality)


def named(names, paths):
    """Records by name."""
    return dict(zip(names, map(records.read_json, paths), strict=True))


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


def write_text(path, text):
    """Write a text whole or not at all."""
    temporary = Path(path).with_name(f".{Path(path).name}.part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


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
            reference_dem_heights=snakemake.params.reference_dem_heights,
            blend_m=snakemake.params.blend_m,
            slope_limit_deg=snakemake.params.slope_limit_deg,
            strip_rows=snakemake.params.strip_rows,
        )
