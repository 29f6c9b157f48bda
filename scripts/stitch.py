"""Join the digitised parts of a film: parts in, the joined film and a record of its seams out."""

import itertools
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from cosp.errors import InputError
from cosp.film.arrangement import SeamLimits, arrange, posed
from cosp.film.stitching import compose, lay_out, refine_seam, require_part
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import tiles
from cosp.io import rasters, records
from cosp.io.logs import log_to


def stitch(
    part_paths,
    stitched_path,
    seams_path,
    *,
    scene,
    missing,
    pixel_um,
    overlap_mm,
    offset_mm,
    feature_pixel_mm,
    ratio,
    min_features,
    min_margin,
    min_score,
    min_inliers,
    feather_mm,
    part_width_mm,
    seed,
    threads,
):
    if missing:
        raise InputError(f"{scene}: no such file: {', '.join(missing)}; needed are parts a to d, or one joined film")
    log = logging.getLogger("stitch")
    pixel_mm = pixel_um / 1000
    names = [Path(path).stem for path in part_paths]
    for path in part_paths:
        found = rasters.info(path)
        require_part(
            str(path),
            shape=found.shape,
            bands=found.count,
            dtype=found.dtype,
            pixel_mm=pixel_mm,
            width_mm=tuple(part_width_mm),
        )
    parts = [rasters.read(path) for path in part_paths]
    log.info("%d parts read", len(parts))

    rng = np.random.default_rng(seed)
    limits = SeamLimits(tuple(overlap_mm), offset_mm, feature_pixel_mm, ratio, min_features, min_margin)
    arrangement = arrange(parts, names=names, pixel_mm=pixel_mm, limits=limits, rng=rng)
    laid = [posed(parts[i], pose) for i, pose in zip(arrangement.order, arrangement.poses, strict=True)]
    order = [names[i] for i in arrangement.order]
    seams = []
    for k, coarse in enumerate(arrangement.seams):
        seams.append(
            refine_seam(
                laid[k],
                laid[k + 1],
                coarse,
                min_score=min_score,
                min_inliers=min_inliers,
                names=(order[k], order[k + 1]),
                rng=rng,
                threads=threads,
            )
        )
        log.info("seam %d/%d: rms %.3f px", k + 1, len(arrangement.seams), seams[k].rms_px)

    layout = lay_out([part.shape for part in laid], seams, feather_px=feather_mm / pixel_mm)
    windows = tiles(layout.shape, (layout.shape[0], 2048))
    grid = PixelGrid(0.0, 0.0, 1.0, -1.0, layout.shape)
    with (
        rasters.create(stitched_path, shape=layout.shape, dtype="uint8", grid=grid, crs=None) as target,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start in range(0, len(windows), threads):
            batch = windows[start : start + threads]
            composed = pool.map(compose, itertools.repeat(laid), itertools.repeat(layout), batch)
            for window, values in zip(batch, composed, strict=False):
                target.write(window, values)
            log.info("joined %d/%d windows", min(start + threads, len(windows)), len(windows))

    records.write(
        seams_path,
        {
            "kind": "seams",
            "version": 1,
            "scene": scene,
            "pixel_mm": pixel_mm,
            "part_order": order,
            "turned": [pose.turned for pose in arrangement.poses],
            "mirrored": [pose.mirrored for pose in arrangement.poses],
            "margin": arrangement.margin,
            "layout": layout,
            "seams": [
                {
                    "left": order[k],
                    "right": order[k + 1],
                    "rotation_deg": float(np.degrees(seam.motion.rotation_rad)),
                    "shift_px": seam.motion.shift,
                    "overlap_mm": seam.overlap_px * pixel_mm,
                    "features": seam.features,
                    "patches": seam.patches,
                    "inliers": seam.inliers,
                    "rms_px": seam.rms_px,
                    "check_rms_px": seam.check_rms_px,
                    "gain": seam.gain,
                    "offset": seam.offset,
                    "residuals_px": seam.residuals.round(3),
                }
                for k, seam in enumerate(seams)
            ],
        },
    )


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        stitch(
            part_paths=list(snakemake.input.parts),
            stitched_path=snakemake.output.stitched,
            seams_path=snakemake.output.seams,
            scene=snakemake.wildcards.scene,
            missing=snakemake.params.missing,
            pixel_um=snakemake.params.pixel_um,
            overlap_mm=snakemake.params.overlap_mm,
            offset_mm=snakemake.params.offset_mm,
            feature_pixel_mm=snakemake.params.feature_pixel_mm,
            ratio=snakemake.params.ratio,
            min_features=snakemake.params.min_features,
            min_margin=snakemake.params.min_margin,
            min_score=snakemake.params.min_score,
            min_inliers=snakemake.params.min_inliers,
            feather_mm=snakemake.params.feather_mm,
            part_width_mm=snakemake.params.part_width_mm,
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
