rule coregister:
    input:
        dem="results/pairs/{pair}/dem.tif",
        reference_dem=of_site("reference_dem"),
        unstable_terrain=site_file("unstable_terrain"),
    output:
        dem="results/pairs/{pair}/dem_coregistered.tif",
        summary="results/pairs/{pair}/coregistration.json",
    log:
        "logs/coregister/{pair}.log",
    benchmark:
        "benchmarks/coregister/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(6),
        runtime=runtime(1),
    params:
        **choices("coregister"),
        library=house.script_digest("coregister"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Coregistering the DEM of {wildcards.pair}"
    script:
        "../scripts/coregister.py"


rule assess_dem:
    input:
        dem="results/pairs/{pair}/dem.tif",
        dem_coregistered="results/pairs/{pair}/dem_coregistered.tif",
        reference_dem=of_site("reference_dem"),
        unstable_terrain=site_file("unstable_terrain"),
        check_dem=site_file("check_dem"),
        area_of_interest=site_file("area_of_interest"),
        fore_film=film_of("fore", "film.tif"),
        aft_film=film_of("aft", "film.tif"),
        cameras=cameras_of_pair,
        ortho="results/pairs/{pair}/ortho.tif",
        points="results/pairs/{pair}/points.json",
        y_parallax="results/pairs/{pair}/y_parallax.json",
        adjustment=block_file("adjustment.json"),
    output:
        difference="results/pairs/{pair}/dem_difference.tif",
        quality="results/pairs/{pair}/quality.json",
        figure=report(
            "results/pairs/{pair}/dem_difference.png",
            caption="../docs/captions/dem_difference.rst",
            category="Elevation",
            labels={"pair": "{pair}", "figure": "elevation differences"},
        ),
        hillshade=report(
            "results/pairs/{pair}/hillshade.png",
            caption="../docs/captions/hillshade.rst",
            category="Elevation",
            labels={"pair": "{pair}", "figure": "hillshade"},
        ),
        histogram=report(
            "results/pairs/{pair}/histogram.png",
            caption="../docs/captions/histogram.rst",
            category="Elevation",
            labels={"pair": "{pair}", "figure": "histogram of differences"},
        ),
    log:
        "logs/assess_dem/{pair}.log",
    benchmark:
        "benchmarks/assess_dem/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(6),
        runtime=runtime(0.5),
    params:
        **choices("assess_dem"),
        library=house.script_digest("assess_dem"),
        fore=member("fore"),
        aft=member("aft"),
        reference_dem_heights=of_site("reference_dem_heights"),
        check_dem_heights=of_site("check_dem_heights"),
    message:
        "Measuring how good the DEM of {wildcards.pair} is"
    script:
        "../scripts/assess_dem.py"


rule mosaic_site:
    input:
        dems=of_pairs_of_site("results/pairs/{pair}/dem_coregistered.tif"),
        orthos=of_pairs_of_site("results/pairs/{pair}/ortho.tif"),
        qualities=of_pairs_of_site("results/pairs/{pair}/quality.json"),
        coregistrations=of_pairs_of_site("results/pairs/{pair}/coregistration.json"),
        figures=of_pairs_of_site(
            [
                "results/pairs/{pair}/hillshade.png",
                "results/pairs/{pair}/dem_difference.png",
                "results/pairs/{pair}/histogram.png",
                "results/pairs/{pair}/disparity.png",
            ]
        ),
        y_parallaxes=of_pairs_of_site("results/pairs/{pair}/y_parallax.tif"),
        films=of_scenes_of_site("results/scenes/{scene}/film.json"),
        gcps=of_scenes_of_site("results/scenes/{scene}/gcps.parquet"),
        gcp_summaries=of_scenes_of_site("results/scenes/{scene}/gcps.json"),
        seams=of_scenes_of_site("results/scenes/{scene}/seams.json"),
        adjustments=of_blocks_of_site("results/blocks/{block}/adjustment.json"),
        cameras=of_blocks_of_site("results/blocks/{block}/cameras"),
        area_of_interest=site_file("area_of_interest"),
        residual_figures=of_blocks_of_site("results/blocks/{block}/residuals.png"),
        field_figures=of_blocks_of_site("results/blocks/{block}/film_fields.png"),
        placement_figures=of_scenes_of_site("results/scenes/{scene}/placement.png"),
        seam_figures=of_scenes_of_site("results/scenes/{scene}/seams.png"),
        bending_figures=of_scenes_of_site("results/scenes/{scene}/bending.png"),
        reference_dem=of_site("reference_dem"),
        unstable_terrain=site_file("unstable_terrain"),
    output:
        dem="results/sites/{site}/dem.tif",
        difference="results/sites/{site}/dem_difference.tif",
        ortho="results/sites/{site}/ortho.tif",
        quality="results/sites/{site}/quality.json",
        page=report(
            "results/sites/{site}/report.html",
            caption="../docs/captions/site.rst",
            category="Sites",
            labels={"site": "{site}", "figure": "quality page"},
        ),
    log:
        "logs/mosaic_site/{site}.log",
    benchmark:
        "benchmarks/mosaic_site/{site}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=3000,
        runtime=60,
    params:
        **choices("mosaic_site"),
        library=house.script_digest("mosaic_site"),
        settings=settings_for_page,
        pairs=lambda wildcards: project.pairs_of_site(wildcards.site),
        scenes=lambda wildcards: project.scenes_of_site(wildcards.site),
        blocks=lambda wildcards: project.blocks_of_site(wildcards.site),
        members=members_of_site_pairs,
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Joining the pairs of {wildcards.site}"
    script:
        "../scripts/mosaic_site.py"
