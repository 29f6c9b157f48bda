"""Adjust the cameras of a block: ground control and tie points in, cameras and their quality out."""

from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import Transformer

from cosp.adjustment import blocks, precision
from cosp.adjustment.observations import PLAIN_PRIORS, Control, Ties
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.imaging.resampling import sample
from cosp.io import heights, rasters, records, tables, vectors
from cosp.io.logs import log_to
from cosp.report import figures
from cosp.report.residuals import FilmResiduals, draw_residuals


def adjust_bundle(
    gcp_paths,
    tie_paths,
    footprint_paths,
    film_paths,
    reference_dem_path,
    unstable_path,
    cameras_folder,
    summary_path,
    residuals_path,
    figure_path,
    *,
    scenes,
    pairs,
    reference_dem_heights,
    film_distortion_um,
    tie_distortion_um,
    gate_sigma,
    correlation_limit,
    grid_step_mm,
    grid_radius_mm,
):
    gcps = [tables.read(path) for path in gcp_paths]
    tie_tables = [tables.read(path) for path in tie_paths]
    pixels_mm = [records.read_json(path)["pixel_mm"] for path in film_paths]
    placed = [camera_of_footprint(path) for path in footprint_paths]
    origin = common_origin(placed)
    cameras = [camera.moved_to(origin) for camera in placed]

    control = [
        control_points(table[table.role == "control"], origin, pixel_mm, film_distortion_um / 1000.0)
        for table, pixel_mm in zip(gcps, pixels_mm, strict=True)
    ]
    checks = [
        control_points(table[table.role == "check"], origin, pixel_mm, film_distortion_um / 1000.0)
        for table, pixel_mm in zip(gcps, pixels_mm, strict=True)
    ]
    ties = [
        tie_points(
            table, scenes.index(fore), scenes.index(aft), pixels_mm[scenes.index(fore)], tie_distortion_um / 1000.0
        )
        for table, (fore, aft) in zip(tie_tables, pairs, strict=True)
    ]

    block = blocks.orient_block(cameras, control, ties, priors=PLAIN_PRIORS, gate_sigma=gate_sigma)
    adjusted = block.adjustment.cameras

    held_out = []
    for points, weights in zip(ties, block.adjustment.tie_weights, strict=True):
        near = precision.in_held_out_blocks(
            points.first_mm, control[points.first].film_mm, checks[points.first].film_mm
        )
        ground, _ = precision.intersect(adjusted, points)
        held_out.append(origin.geodetic_from_local(ground[near & (weights > 0)]))
    tie_lonlath = np.concatenate([np.empty((0, 3)), *held_out])
    errors = blocks.check_errors(
        adjusted,
        checks,
        tie_heights_m=tie_lonlath[:, 2],
        reference_heights_m=reference_heights(reference_dem_path, reference_dem_heights, unstable_path, tie_lonlath),
        gate_sigma=gate_sigma,
    )
    summary = blocks.summary(
        block,
        control,
        ties,
        checks,
        errors,
        pixels_mm=pixels_mm,
        priors=PLAIN_PRIORS,
        correlation_limit=correlation_limit,
    )

    for camera in adjusted:
        records.write(Path(cameras_folder) / f"{camera.scene}.json", camera)
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
    records.write(summary_path, summary)


def camera_of_footprint(path):
    return records.from_plain(records.read_json(path)["camera"], PanoramicCamera, str(path))


def common_origin(cameras):
    """The middle of the footprints, on the ellipsoid."""
    centres = np.mean([camera.locate_geodetic(np.zeros(2), 0.0) for camera in cameras], axis=0)
    return LocalFrame(float(centres[0]), float(centres[1]))


def control_points(table, origin, pixel_mm, distortion_mm):
    ground = origin.local_from_geodetic(table[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    return Control(
        film_mm=table[["x_mm", "y_mm"]].to_numpy(),
        ground_m=ground,
        sigma_mm=np.hypot(table.sigma_px.to_numpy() * pixel_mm, distortion_mm),
        sigma_ground_m=table.sigma_ground_m.to_numpy(),
        sigma_height_m=table.sigma_height_m.to_numpy(),
    )


def tie_points(table, first, second, pixel_mm, distortion_mm):
    return Ties(
        first=first,
        second=second,
        first_mm=table[["fore_x_mm", "fore_y_mm"]].to_numpy(),
        second_mm=table[["aft_x_mm", "aft_y_mm"]].to_numpy(),
        sigma_mm=np.hypot(table.sigma_px.to_numpy() * pixel_mm, distortion_mm),
    )


def reference_heights(dem_path, dem_heights, unstable_path, lonlath):
    """Ellipsoidal heights of the reference at points; NaN outside it and on unstable terrain."""
    if not len(lonlath):
        return np.empty(0)
    info = rasters.info(dem_path)
    to_map = Transformer.from_crs("EPSG:4326", info.crs, always_xy=True)
    east_north = np.stack(to_map.transform(lonlath[:, 0], lonlath[:, 1]), axis=-1)
    rows, columns = info.grid.pixels(east_north)
    row0, column0 = (max(0, int(np.floor(a.min())) - 2) for a in (rows, columns))
    row1 = min(info.shape[0], int(np.ceil(rows.max())) + 3)
    column1 = min(info.shape[1], int(np.ceil(columns.max())) + 3)
    if row0 >= row1 or column0 >= column1:
        return np.full(len(lonlath), np.nan)
    grid = info.grid.window(row0, row1, column0, column1)
    values = rasters.read_on_grid(dem_path, grid, info.crs)
    if unstable_path:
        values[vectors.rasterise(unstable_path, grid, info.crs)] = np.nan
    found = sample(values, rows - row0, columns - column0, interpolation="linear", border=np.nan)
    return found + heights.undulation_at(lonlath[:, :2], dem_heights)


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
            "group": "gcp",
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
                    "group": "tie",
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
            footprint_paths=list(snakemake.input.footprints),
            film_paths=list(snakemake.input.films),
            reference_dem_path=snakemake.input.reference_dem,
            unstable_path=snakemake.input.get("unstable_terrain"),
            cameras_folder=snakemake.output.cameras,
            summary_path=snakemake.output.summary,
            residuals_path=snakemake.output.residuals,
            figure_path=snakemake.output.figure,
            scenes=snakemake.params.scenes,
            pairs=snakemake.params.pairs,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            film_distortion_um=snakemake.params.film_distortion_um,
            tie_distortion_um=snakemake.params.tie_distortion_um,
            gate_sigma=snakemake.params.gate_sigma,
            correlation_limit=snakemake.params.correlation_limit,
            grid_step_mm=snakemake.params.grid_step_mm,
            grid_radius_mm=snakemake.params.grid_radius_mm,
        )
