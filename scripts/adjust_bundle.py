"""Adjust the cameras of a block: ground control and tie points in, cameras and their quality out."""

from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import Transformer

from cosp.adjustment import blocks, precision
from cosp.adjustment.calibration import FieldChoices
from cosp.adjustment.fieldprior import joints_on_film
from cosp.adjustment.observations import Control, HeightReference, Ties
from cosp.adjustment.posterior import height_sigma
from cosp.camera.panoramic import PanoramicCamera
from cosp.film.joining import Layout
from cosp.film.scanner import Blocks
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import sample
from cosp.io import heights, rasters, records, tables, vectors
from cosp.io.logs import log_to
from cosp.matching.dem_control import SOURCE
from cosp.report import figures
from cosp.report.residuals import FilmResiduals, draw_residuals

FIELD_GRID_MM = 5.0  # posting of the exported fields
HEIGHT_SIGMA_MM = 10.0  # posting of the standard deviation of heights
WITHHELD = "withheld"  # control by elevation models in blocks held out: no check, since it was measured with cameras


def adjust_bundle(
    gcp_paths,
    tie_paths,
    neighbour_paths,
    footprint_paths,
    film_paths,
    seams_paths,
    reference_dem_path,
    unstable_path,
    cameras_folder,
    fields_folder,
    height_sigma_folder,
    summary_path,
    residuals_path,
    figure_path,
    field_figure_path,
    *,
    scenes,
    pairs,
    pair_names,
    neighbours,
    reference_dem_heights,
    model,
    knots_along_mm,
    knots_across_mm,
    correlation_lengths_mm,
    reference_sigma_m,
    reference_smooth_sigma_m,
    reference_sigma_horizontal_m,
    max_slope_deg,
    film_distortion_um,
    tie_distortion_um,
    gate_sigma,
    correlation_limit,
    joint_sigma_px,
    block_sigma_px,
    focal_length,
    focal_sigma_mm,
    grid_step_mm,
    grid_radius_mm,
    dem_gcps_paths=(),
):
    gcps = [tables.read(path) for path in gcp_paths]
    films = [records.read_json(path) for path in film_paths]
    pixels_mm = [film["pixel_mm"] for film in films]
    footprints = [records.read_json(path) for path in footprint_paths]
    placed = [
        records.from_plain(footprint["camera"], PanoramicCamera, str(path))
        for footprint, path in zip(footprints, footprint_paths, strict=True)
    ]
    origin = common_origin(placed)
    cameras = [camera.moved_to(origin) for camera in placed]

    if dem_gcps_paths:
        of_dems = pd.concat([tables.read(path) for path in dem_gcps_paths], ignore_index=True)
        gcps = [
            with_dem_control(table, of_dems[of_dems.scene == scene]) for table, scene in zip(gcps, scenes, strict=True)
        ]
    control, checks, kept_back = (
        [
            control_points(table[table.role.isin(roles)], origin, pixel_mm)
            for table, pixel_mm in zip(gcps, pixels_mm, strict=True)
        ]
        for roles in (["control"], ["check"], ["check", WITHHELD])
    )
    stereo = [
        tie_points(tables.read(path), ("fore", "aft"), scenes.index(fore), scenes.index(aft), pixels_mm)
        for path, (fore, aft) in zip(tie_paths, pairs, strict=True)
    ]
    ties = stereo + [
        tie_points(tables.read(path), ("first", "second"), scenes.index(first), scenes.index(second), pixels_mm)
        for path, (first, second) in zip(neighbour_paths, neighbours, strict=True)
    ]
    held_out = [
        precision.in_held_out_blocks(points.first_mm, control[points.first].film_mm, checks[points.first].film_mm)
        for points in ties
    ]
    reference = HeightReference(
        reference_surface(reference_dem_path, reference_dem_heights, unstable_path, cameras),
        sigma_m=reference_sigma_m,
        sigma_horizontal_m=reference_sigma_horizontal_m,
        largest_slope_deg=max_slope_deg,
    )
    field = FieldChoices(knots_along_mm, knots_across_mm, tuple(correlation_lengths_mm)) if model == "field" else None
    film_groups = [int(scene in {aft for _, aft in pairs}) for scene in scenes]
    choices = {
        "field": field,
        "reference": reference,
        "gate_sigma": gate_sigma,
        "film_groups": film_groups,
        "place_sigmas_m": [footprint.get("sigma_m", np.nan) for footprint in footprints],
        "joints": [
            film_joints(path, film, camera, joint_sigma_px, block_sigma_px)
            for path, film, camera in zip(seams_paths, films, cameras, strict=True)
        ],
        "bending_mm": [film["bending"]["sd_mm"] for film in films],
        "focal_sigma_mm": focal_sigma_mm if focal_length == "free" else None,
    }

    block = blocks.orient_block(
        cameras,
        control,
        ties,
        film_distortion_mm=film_distortion_um / 1000.0,
        tie_distortion_mm=tie_distortion_um / 1000.0,
        held_out=held_out,
        **choices,
    )
    errors, plain_errors = (
        check_errors(adjustment, checks, ties, held_out, reference, gate_sigma)
        for adjustment in (block.adjustment, block.plain)
    )
    final = blocks.with_checks(block, control, kept_back, ties, prior_cameras=cameras, **choices)
    summary = blocks.summary(
        block,
        final,
        control,
        ties,
        checks,
        errors,
        plain_errors,
        pixels_mm=pixels_mm,
        film_distortion_mm=film_distortion_um / 1000.0,
        tie_distortion_mm=tie_distortion_um / 1000.0,
        correlation_limit=correlation_limit,
        focal_sigma_mm=choices["focal_sigma_mm"],
    )

    for camera in final.adjustment.cameras:
        records.write(Path(cameras_folder) / f"{camera.scene}.json", camera)
        write_field(Path(fields_folder) / f"{camera.scene}.tif", camera)
    for name, (fore, aft), points in zip(pair_names, pairs, stereo, strict=True):
        sigma = height_sigma(
            final.adjustment.cameras,
            scenes.index(fore),
            scenes.index(aft),
            covariance=final.adjustment.covariance,
            calibration=final.calibration,
            film_sigma_mm=final.calibration.unmodelled_mm if field else film_distortion_um / 1000.0,
            reference_sigma_m=reference_smooth_sigma_m if field else 0.0,
            height_m=mean_height_m(final.adjustment, points),
            step_mm=HEIGHT_SIGMA_MM,
        )
        records.write(Path(height_sigma_folder) / f"{name}.json", sigma)
    adjusted = block.adjustment.cameras
    table = pd.concat(
        [
            *(
                gcp_residuals(*image)
                for image in zip(adjusted, gcps, block.adjustment.control_weights, pixels_mm, strict=True)
            ),
            *(
                tie_residuals(adjusted, points, weights, pixels_mm)
                for points, weights in zip(ties, block.adjustment.tie_weights, strict=True)
            ),
        ]
    )
    tables.write(residuals_path, table)
    figure = draw_residuals([film_residuals(camera, table, grid_step_mm, grid_radius_mm) for camera in adjusted])
    figures.save(figure, figure_path, dpi=120)
    drawn = [
        film_field(camera, points, pixel_mm)
        for camera, points, pixel_mm in zip(final.adjustment.cameras, control, pixels_mm, strict=True)
    ]
    figures.save(draw_residuals(drawn, label="displacement, px"), field_figure_path, dpi=120)
    records.write(summary_path, summary)


def common_origin(cameras):
    """The middle of the footprints, on the ellipsoid."""
    centres = np.mean([camera.locate_geodetic(np.zeros(2), 0.0) for camera in cameras], axis=0)
    return LocalFrame(float(centres[0]), float(centres[1]))


def with_dem_control(gcps, of_dems):
    """Control of a film and what elevation models add, in the blocks of the film that are not held out."""
    film = of_dems[["x_mm", "y_mm"]].to_numpy()
    held_out = precision.in_held_out_blocks(
        film, *(gcps.loc[gcps.role == role, ["x_mm", "y_mm"]].to_numpy() for role in ("control", "check"))
    )
    both = [gcps, of_dems.drop(columns="scene").assign(role=np.where(held_out, WITHHELD, "control"))]
    return pd.concat([part for part in both if len(part)], ignore_index=True) if len(of_dems) else gcps


def control_points(table, origin, pixel_mm):
    """Control points of a table; of those by elevation models the covariance on the film says all."""
    ground = origin.local_from_geodetic(table[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    by_dem = table.source.to_numpy() == SOURCE
    sigma_mm = pixel_mm * np.where(by_dem[:, None], table[["sigma_x_px", "sigma_y_px"]], 0.0)
    covariance = sigma_mm[:, :, None] * sigma_mm[:, None, :]
    covariance[:, [0, 1], [1, 0]] *= table.correlation_xy.to_numpy()[:, None]
    return Control(
        film_mm=table[["x_mm", "y_mm"]].to_numpy(),
        ground_m=ground,
        sigma_mm=table.sigma_px.to_numpy() * pixel_mm,
        sigma_ground_m=np.where(by_dem, 0.0, table.sigma_ground_m),
        sigma_height_m=np.where(by_dem, 0.0, table.sigma_height_m),
        covariance_mm2=covariance,
    )


def tie_points(table, names, first, second, pixels_mm):
    return Ties(
        first=first,
        second=second,
        first_mm=table[[f"{names[0]}_x_mm", f"{names[0]}_y_mm"]].to_numpy(),
        second_mm=table[[f"{names[1]}_x_mm", f"{names[1]}_y_mm"]].to_numpy(),
        sigma_mm=table.sigma_px.to_numpy() * pixels_mm[first],
        neighbours=names == ("first", "second"),
    )


def film_joints(seams_path, film, camera, joint_sigma_px, block_sigma_px):
    """Where on a film its parts were joined and, where they were found, the limits of the scanner's blocks lie."""
    seams = records.read_json(seams_path)
    layout = records.from_plain(seams["layout"], Layout, f"{seams_path}: layout")
    blocks_found = seams["scanner_blocks"]
    columns = []
    if blocks_found is not None:
        scanner = records.from_plain(blocks_found, Blocks, f"{seams_path}: scanner_blocks")
        ends = [-np.inf, *layout.joints_px, np.inf]
        for part, motion in enumerate(layout.motions):
            along = scanner.along(part, layout.shape[1] * seams["pixel_mm"]) / seams["pixel_mm"]
            joined = motion.apply(np.column_stack([along, np.zeros(len(along))]))[:, 0]
            columns += joined[(joined > ends[part]) & (joined < ends[part + 1])].tolist()
    exposure = film["exposure"]
    sense = -1.0 if film["turned"] else 1.0
    joints_mm, limits_mm = (
        sense * (np.array(places) - exposure["centre_px"][0]) * exposure["pixel_mm"]
        for places in (layout.joints_px, columns)
    )
    return joints_on_film(
        joints_mm,
        limits_mm,
        half_length_mm=camera.half_length_mm,
        joint_sigma_mm=joint_sigma_px * film["pixel_mm"],
        limit_sigma_mm=block_sigma_px * film["pixel_mm"],
    )


def reference_surface(dem_path, dem_heights, unstable_path, cameras):
    """Function that gives ellipsoidal heights of the reference about the films; NaN outside, on unstable terrain."""
    lonlat = np.concatenate([camera.locate_geodetic(outline(camera), 0.0)[:, :2] for camera in cameras])
    info = rasters.info(dem_path)
    to_map = Transformer.from_crs("EPSG:4326", info.crs, always_xy=True)
    rows, columns = info.grid.pixels(np.stack(to_map.transform(lonlat[:, 0], lonlat[:, 1]), axis=-1))
    ends = []
    for places, size in ((rows, info.shape[0]), (columns, info.shape[1])):
        margin = 0.1 * np.ptp(places) + 4.0
        ends.append((max(0, int(places.min() - margin)), min(size, int(places.max() + margin))))
    (row0, row1), (column0, column1) = ends
    if row0 >= row1 or column0 >= column1:
        return lambda lonlat: np.full(len(lonlat), np.nan)
    grid = info.grid.window(row0, row1, column0, column1)
    values = heights.ellipsoidal_heights(dem_path, grid, info.crs, dem_heights)
    if unstable_path:
        values[vectors.rasterise(unstable_path, grid, info.crs)] = np.nan

    def heights_at(lonlat):
        places = grid.pixels(np.stack(to_map.transform(lonlat[:, 0], lonlat[:, 1]), axis=-1))
        rows, columns = (np.where(np.isfinite(place), place, -9.0) for place in places)
        return sample(values, rows, columns, interpolation="linear", border=np.nan).astype(float)

    return heights_at


def outline(camera):
    """Film points along the edge of a film."""
    x = np.linspace(-camera.half_length_mm, camera.half_length_mm, 25)
    return np.concatenate([np.column_stack([x, np.full(25, y)]) for y in (-camera.half_width_mm, camera.half_width_mm)])


def check_errors(adjustment, checks, ties, held_out, reference, gate_sigma):
    """Errors at check points, and of heights at tie points in the blocks held out."""
    origin = adjustment.cameras[0].origin
    found = [np.empty((0, 3))]
    for points, weights, chosen in zip(ties, adjustment.tie_weights, held_out, strict=True):
        if points.neighbours:
            continue
        ground, _ = precision.intersect(adjustment.cameras, points)
        found.append(origin.geodetic_from_local(ground[chosen & (weights > 0)]))
    lonlath = np.concatenate(found)
    return blocks.check_errors(
        adjustment.cameras,
        checks,
        tie_heights_m=lonlath[:, 2],
        reference_heights_m=reference.heights_at(lonlath[:, :2]),
        gate_sigma=gate_sigma,
    )


def mean_height_m(adjustment, ties):
    """Mean ellipsoidal height of the tie points of a pair; 0 without any."""
    ground, _ = precision.intersect(adjustment.cameras, ties)
    height = adjustment.cameras[0].origin.geodetic_from_local(ground)[:, 2]
    return float(np.nanmedian(height)) if np.isfinite(height).any() else 0.0


def write_field(path, camera):
    """Displacement of a film on a grid, along and across, in mm."""
    places, displacement = blocks.field_grid(camera, FIELD_GRID_MM)
    rasters.write(
        path,
        np.moveaxis(displacement, -1, 0).astype(np.float32),
        grid=PixelGrid(places[0, 0, 0], places[0, 0, 1], FIELD_GRID_MM, -FIELD_GRID_MM, places.shape[:2]),
        crs=rasters.FILM_CRS,
        descriptions=("dx_mm", "dy_mm"),
    )


def film_field(camera, control, pixel_mm):
    """The field of one film, to be drawn."""
    nodes, displacement = blocks.field_grid(camera, 2.0 * FIELD_GRID_MM)
    size = np.sqrt(np.mean(displacement**2, axis=(0, 1))) * 1000.0
    caption = f"film distortion, rms {size[0]:.1f} um along, {size[1]:.1f} um across; {len(control)} control points"
    return FilmResiduals(camera.scene, nodes, displacement / pixel_mm, control.film_mm, caption)


def gcp_residuals(camera, gcps, weights, pixel_mm):
    lonlath = gcps[["longitude_deg", "latitude_deg", "height_m"]].to_numpy()
    film = gcps[["x_mm", "y_mm"]].to_numpy()
    ground = camera.origin.local_from_geodetic(lonlath)
    residuals = precision.film_residuals(camera, film, ground) / pixel_mm
    error = precision.horizontal_errors(camera, film, ground)
    role, weight = gcps.role.to_numpy().astype(object), np.full(len(gcps), np.nan)
    controlled = np.flatnonzero(role == "control")
    weight[controlled] = weights
    role[controlled[weights == 0]] = "rejected"
    return pd.DataFrame(
        {
            "scene": camera.scene,
            "group": np.where(gcps.source == SOURCE, "dem", "gcp"),
            "role": role.astype(str),
            "x_mm": film[:, 0],
            "y_mm": film[:, 1],
            "residual_x_px": residuals[:, 0],
            "residual_y_px": residuals[:, 1],
            "weight": weight,
            "longitude_deg": lonlath[:, 0],
            "latitude_deg": lonlath[:, 1],
            "height_m": lonlath[:, 2],
            "error_east_m": error[:, 0],
            "error_north_m": error[:, 1],
            "ray_gap_m": np.nan,
        }
    )


def tie_residuals(cameras, ties, weights, pixels_mm):
    ground, gap_m = precision.intersect(cameras, ties)
    lonlath = cameras[0].origin.geodetic_from_local(ground)
    sides = zip(
        (ties.first, ties.second),
        (ties.first_mm, ties.second_mm),
        precision.tie_residuals(cameras, ties, ground),
        strict=True,
    )
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "scene": cameras[image].scene,
                    "group": "neighbour" if ties.neighbours else "tie",
                    "role": np.where(weights > 0, "tie", "rejected"),
                    "x_mm": film[:, 0],
                    "y_mm": film[:, 1],
                    "residual_x_px": residuals[:, 0] / pixels_mm[image],
                    "residual_y_px": residuals[:, 1] / pixels_mm[image],
                    "weight": weights,
                    "longitude_deg": lonlath[:, 0],
                    "latitude_deg": lonlath[:, 1],
                    "height_m": lonlath[:, 2],
                    "error_east_m": np.nan,
                    "error_north_m": np.nan,
                    "ray_gap_m": gap_m,
                }
            )
            for image, film, residuals in sides
        ]
    )


def film_residuals(camera, table, step_mm, radius_mm):
    """Residuals of the ground control of one film, smoothed onto a grid."""
    rows = table[(table.scene == camera.scene) & (table.group == "gcp") & (table.role != "rejected")]
    film = rows[["x_mm", "y_mm"]].to_numpy()
    residuals = rows[["residual_x_px", "residual_y_px"]].to_numpy()
    nodes, smoothed = precision.residual_grid(
        film,
        residuals,
        half_size_mm=(camera.half_length_mm, camera.half_width_mm),
        step_mm=step_mm,
        radius_mm=radius_mm,
    )
    rms_x, rms_y = precision.rms_per_axis(residuals)
    caption = f"{len(rows)} ground control and check points, rms {rms_x:.2f} px along, {rms_y:.2f} px across the film"
    return FilmResiduals(camera.scene, nodes, smoothed, film, caption)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        adjust_bundle(
            gcp_paths=list(snakemake.input.gcps),
            tie_paths=list(snakemake.input.tie_points),
            neighbour_paths=list(snakemake.input.neighbour_points),
            dem_gcps_paths=list(snakemake.input.dem_gcps),
            footprint_paths=list(snakemake.input.footprints),
            film_paths=list(snakemake.input.films),
            seams_paths=list(snakemake.input.seams),
            reference_dem_path=snakemake.input.reference_dem,
            unstable_path=snakemake.input.get("unstable_terrain"),
            cameras_folder=snakemake.output.cameras,
            fields_folder=snakemake.output.fields,
            height_sigma_folder=snakemake.output.height_sigma,
            summary_path=snakemake.output.summary,
            residuals_path=snakemake.output.residuals,
            figure_path=snakemake.output.figure,
            field_figure_path=snakemake.output.field_figure,
            scenes=snakemake.params.scenes,
            pairs=snakemake.params.pairs,
            pair_names=snakemake.params.pair_names,
            neighbours=snakemake.params.neighbours,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            model=snakemake.params.model,
            knots_along_mm=snakemake.params.knots_along_mm,
            knots_across_mm=snakemake.params.knots_across_mm,
            correlation_lengths_mm=snakemake.params.correlation_lengths_mm,
            reference_sigma_m=snakemake.params.reference_sigma_m,
            reference_smooth_sigma_m=snakemake.params.reference_smooth_sigma_m,
            reference_sigma_horizontal_m=snakemake.params.reference_sigma_horizontal_m,
            max_slope_deg=snakemake.params.max_slope_deg,
            film_distortion_um=snakemake.params.film_distortion_um,
            tie_distortion_um=snakemake.params.tie_distortion_um,
            gate_sigma=snakemake.params.gate_sigma,
            correlation_limit=snakemake.params.correlation_limit,
            joint_sigma_px=snakemake.params.joint_sigma_px,
            block_sigma_px=snakemake.params.block_sigma_px,
            focal_length=snakemake.params.focal_length,
            focal_sigma_mm=snakemake.params.focal_sigma_mm,
            grid_step_mm=snakemake.params.grid_step_mm,
            grid_radius_mm=snakemake.params.grid_radius_mm,
        )
