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
        gcps=of_block("results/scenes/{scene}/gcps.parquet"),
        footprints=of_block("results/scenes/{scene}/footprint.json"),
        films=of_block("results/scenes/{scene}/film.json"),
        seams=of_block("results/scenes/{scene}/seams.json"),
        tie_points=of_pairs_of_block("results/pairs/{pair}/tie_points.parquet"),
        neighbour_points=of_neighbours(
            "results/blocks/{block}/neighbours/{first}_{second}.parquet"
        ),
        reference_dem=of_site("reference_dem"),
        unstable_terrain=site_file("unstable_terrain"),
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
