rule predict_camera:
    input:
        film_summary="results/scenes/{scene}/straight.json",
    output:
        camera="results/scenes/{scene}/camera_predicted.json",
    log:
        "logs/predict_camera/{scene}.log",
    benchmark:
        "benchmarks/predict_camera/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        library=house.script_digest("predict_camera"),
        scene=of_scene("scene"),
        camera=of_scene("camera"),
        look=of_scene("look"),
        corners=of_scene("corners_deg"),
    message:
        "First camera of {wildcards.scene} from its corners"
    script:
        "../scripts/predict_camera.py"


rule adjust_bundle:
    input:
        **OBSERVATIONS_OF_BLOCK,
        dem_gcps=of_pairs_with_dem_control("results/pairs/{pair}/dem_gcps.parquet"),
    output:
        cameras=directory("results/blocks/{block}/cameras"),
        fields=directory("results/blocks/{block}/fields"),
        height_sigma=directory("results/blocks/{block}/height_sigma"),
        summary="results/blocks/{block}/adjustment.json",
        residuals="results/blocks/{block}/residuals.parquet",
        figure=report(
            "results/blocks/{block}/residuals.png",
            caption="../docs/captions/residuals.rst",
            category="Orientation",
            labels={"block": "{block}", "figure": "residuals of the adjustment"},
        ),
        field_figure=report(
            "results/blocks/{block}/film_fields.png",
            caption="../docs/captions/film_fields.rst",
            category="Orientation",
            labels={"block": "{block}", "figure": "distortion of the films"},
        ),
    log:
        "logs/adjust_bundle/{block}.log",
    benchmark:
        "benchmarks/adjust_bundle/{block}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=60,
    params:
        **choices("adjust_bundle"),
        reference_dem_heights=of_site("reference_dem_heights"),
        library=house.script_digest("adjust_bundle"),
        scenes=scenes_of_block,
        pairs=members_of_block_pairs,
        pair_names=pairs_of_block,
        neighbours=neighbours_of_block,
    message:
        "Adjusting the cameras of {wildcards.block}"
    script:
        "../scripts/adjust_bundle.py"


# First cameras, where a draft of the elevation model is to give more control.
use rule adjust_bundle as adjust_draft with:
    input:
        **OBSERVATIONS_OF_BLOCK,
        dem_gcps=[],
    output:
        cameras=directory("results/blocks/{block}/draft/cameras"),
        fields=directory("results/blocks/{block}/draft/fields"),
        height_sigma=directory("results/blocks/{block}/draft/height_sigma"),
        summary="results/blocks/{block}/draft/adjustment.json",
        residuals="results/blocks/{block}/draft/residuals.parquet",
        figure="results/blocks/{block}/draft/residuals.png",
        field_figure="results/blocks/{block}/draft/film_fields.png",
    log:
        "logs/adjust_draft/{block}.log",
    benchmark:
        "benchmarks/adjust_draft/{block}.jsonl"
    message:
        "First cameras of {wildcards.block}"


rule match_dem:
    input:
        fore_film=film_of("fore", "film.tif"),
        aft_film=film_of("aft", "film.tif"),
        cameras=block_file("draft/cameras"),
        reference_dem=of_site("reference_dem"),
        unstable_terrain=site_file("unstable_terrain"),
    output:
        gcps="results/pairs/{pair}/dem_gcps.parquet",
        summary="results/pairs/{pair}/dem_gcps.json",
        figure=report(
            "results/pairs/{pair}/dem_gcps.png",
            caption="../docs/captions/dem_gcps.rst",
            category="Orientation",
            labels={"pair": "{pair}", "figure": "draft model against the reference"},
        ),
    log:
        "logs/match_dem/{pair}.log",
    benchmark:
        "benchmarks/match_dem/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=2500,
        runtime=30,
    params:
        **choices("match_dem"),
        rectify=choices("rectify"),
        y_parallax=choices("measure_y_parallax"),
        dense=choices("match_dense"),
        triangulate=choices("triangulate"),
        grid_dem=choices("grid_dem"),
        library=house.script_digest("match_dem"),
        fore=member("fore"),
        aft=member("aft"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Control of {wildcards.pair} from a draft of its elevation model"
    script:
        "../scripts/match_dem.py"


rule export_cameras:
    input:
        cameras="results/blocks/{block}/cameras",
        films=of_block("results/scenes/{scene}/film.tif"),
        reference_dem=of_site("reference_dem"),
    output:
        exports=directory("results/blocks/{block}/exports"),
    log:
        "logs/export_cameras/{block}.log",
    benchmark:
        "benchmarks/export_cameras/{block}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        **choices("export_cameras"),
        reference_dem_heights=of_site("reference_dem_heights"),
        library=house.script_digest("export_cameras"),
        scenes=scenes_of_block,
    message:
        "Cameras of {wildcards.block} for other programs"
    script:
        "../scripts/export_cameras.py"
