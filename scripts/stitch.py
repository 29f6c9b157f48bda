"""Find how the digitised parts of a film join: parts in, a record of their seams and places out."""

import logging
from pathlib import Path

import numpy as np

from cosp.errors import InputError
from cosp.film.arrangement import SeamLimits, arrange, posed
from cosp.film.continuity import measure_continuity
from cosp.film.joining import lay_out
from cosp.film.scanner import find_steps, measure_overlap, steps_of_parts, without_steps
from cosp.film.stitching import refine_seam, require_part
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.report import figures
from cosp.report.film import SeamProfile, draw_seams


def stitch(
    part_paths,
    seams_path,
    figure_path,
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
    step_search_px,
    step_significance,
    min_step_px,
    step_tolerance_mm,
    feather_mm,
    part_width_mm,
    seed,
    threads,
):
    if missing:
        raise InputError(f"{scene}: no such file: {', '.join(missing)}; needed are parts a to d, or one joined film")
    log = logging.getLogger("stitch")
    pixel_mm = pixel_um / 1000
    names, files = ([getattr(Path(path), what) for path in part_paths] for what in ("stem", "name"))
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
    arrangement = arrange(parts, names=files, pixel_mm=pixel_mm, limits=limits, rng=rng)
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
                names=tuple(files[i] for i in arrangement.order[k : k + 2]),
                rng=rng,
                threads=threads,
            )
        )
        log.info("seam %d/%d: rms %.3f px", k + 1, len(arrangement.seams), seams[k].rms_px)

    overlaps = [
        measure_overlap(
            laid[k], laid[k + 1], seam.motion, min_score=min_score, search_px=step_search_px, threads=threads
        )
        for k, seam in enumerate(seams)
    ]
    found, boundaries, blocks = find_steps(
        overlaps,
        [seam.motion for seam in seams],
        [measure_continuity(part, reach_px=step_search_px, threads=threads) for part in laid],
        pixel_mm=pixel_mm,
        min_significance=step_significance,
        min_step_px=min_step_px,
        tolerance_mm=step_tolerance_mm,
    )
    steps = steps_of_parts(found, boundaries)
    for k, jumps in enumerate(found):
        log.info("seam %d/%d: %d steps of the scanner", k + 1, len(seams), len(jumps))
        if jumps or steps[k].columns_px or steps[k + 1].columns_px:
            seams[k] = without_steps(seams[k], overlaps[k], steps[k], steps[k + 1])

    layout = lay_out([part.shape for part in laid], seams, feather_px=feather_mm / pixel_mm, steps=steps)
    figures.save(
        draw_seams(
            [profile(o, j, pixel_mm, order[k : k + 2]) for k, (o, j) in enumerate(zip(overlaps, found, strict=True))],
            title=f"{scene}: residuals of the overlaps and steps of the scanner",
        ),
        figure_path,
        dpi=100,
    )
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
            "scanner_blocks": blocks,
            "steps_between_overlaps": boundaries,
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
                    "steps": found[k],
                    "profile": {
                        "column_px": overlaps[k].column_px,
                        "residual_px": overlaps[k].shift_px.round(4),
                        "sd_px": overlaps[k].sd_px.round(4),
                    },
                }
                for k, seam in enumerate(seams)
            ],
        },
    )


def profile(overlap, jumps, pixel_mm, names):
    """What the figure of a seam shows."""
    steps = np.zeros_like(overlap.shift_px)
    for jump in jumps:
        steps[overlap.column_px > jump.left_px] += jump.size_px
    start = overlap.column_px[0] if len(overlap.column_px) else 0.0
    return SeamProfile(" - ".join(names), (overlap.column_px - start) * pixel_mm, overlap.shift_px, steps)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        stitch(
            part_paths=list(snakemake.input.parts),
            seams_path=snakemake.output.seams,
            figure_path=snakemake.output.figure,
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
            step_search_px=snakemake.params.step_search_px,
            step_significance=snakemake.params.step_significance,
            min_step_px=snakemake.params.min_step_px,
            step_tolerance_mm=snakemake.params.step_tolerance_mm,
            feather_mm=snakemake.params.feather_mm,
            part_width_mm=snakemake.params.part_width_mm,
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
