rule locate_coarsely:
    input:
        film="results/scenes/{scene}/straight.tif",
        camera="results/scenes/{scene}/camera_predicted.json",
        reference_dem=of_site("reference_dem"),
        reference_image=site_file("reference_image"),
    output:
        placement="results/scenes/{scene}/placement.json",
        figure=report(
            "results/scenes/{scene}/placement.png",
            caption="../docs/captions/placement.rst",
            category="Control",
            labels={"scene": "{scene}", "figure": "search for the film on the ground"},
        ),
    log:
        "logs/locate_coarsely/{scene}.log",
    benchmark:
        "benchmarks/locate_coarsely/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(2),
        runtime=30,
    params:
        **choices("locate_coarsely"),
        library=house.script_digest("locate_coarsely"),
        day=of_scene("date"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Searching where {wildcards.scene} lies"
    script:
        "../scripts/locate_coarsely.py"


rule place_frame:
    input:
        placement="results/scenes/{scene}/placement.json",
        others=others_of_block("results/scenes/{scene}/placement.json"),
        film="results/scenes/{scene}/straight.tif",
        film_summary="results/scenes/{scene}/straight.json",
        camera="results/scenes/{scene}/camera_predicted.json",
        reference_dem=of_site("reference_dem"),
        reference_image=site_file("reference_image"),
    output:
        footprint="results/scenes/{scene}/footprint.json",
        film="results/scenes/{scene}/film.tif",
        film_summary="results/scenes/{scene}/film.json",
    log:
        "logs/place_frame/{scene}.log",
    benchmark:
        "benchmarks/place_frame/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(2),
        runtime=30,
    params:
        **choices("locate_coarsely"),
        library=house.script_digest("place_frame"),
        day=of_scene("date"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Settling where {wildcards.scene} lies, and which way round its film is"
    script:
        "../scripts/place_frame.py"


rule match_tiles:
    input:
        film="results/scenes/{scene}/film.tif",
        footprint="results/scenes/{scene}/footprint.json",
        reference_dem=of_site("reference_dem"),
        reference_image=site_file("reference_image"),
    output:
        matches=temp("results/scenes/{scene}/matches/{scatteritem}.parquet"),
    log:
        "logs/match_tiles/{scene}_{scatteritem}.log",
    benchmark:
        "benchmarks/match_tiles/{scene}_{scatteritem}.jsonl"
    conda:
        (
            "../envs/learned-matching.yaml"
            if choices("match_tiles")["matcher"] == "lightglue"
            else "../envs/cosp.yaml"
        )
    threads: 1
    resources:
        mem_mb=(
            memory(1)
            if choices("match_tiles")["matcher"] in ("structural", "sift")
            else 4000
        ),
        runtime=runtime(2),
    params:
        **choices("match_tiles"),
        library=house.script_digest("match_tiles"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Matching {wildcards.scene} with the reference, strip {wildcards.scatteritem}"
    script:
        "../scripts/match_tiles.py"


rule collect_gcps:
    input:
        matches=gather.match_tiles(
            "results/scenes/{{scene}}/matches/{scatteritem}.parquet"
        ),
        film="results/scenes/{scene}/film.tif",
        footprint="results/scenes/{scene}/footprint.json",
        reference_dem=of_site("reference_dem"),
        reference_image=site_file("reference_image"),
        unstable_terrain=site_file("unstable_terrain"),
        own_gcps=site_file("gcps"),
    output:
        gcps="results/scenes/{scene}/gcps.parquet",
        summary="results/scenes/{scene}/gcps.json",
    log:
        "logs/collect_gcps/{scene}.log",
    benchmark:
        "benchmarks/collect_gcps/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=3000,
        runtime=15,
    params:
        **choices("collect_gcps"),
        library=house.script_digest("collect_gcps"),
        reference_dem_heights=of_site("reference_dem_heights"),
        needed=is_alone,
    message:
        "Choosing ground control of {wildcards.scene}"
    script:
        "../scripts/collect_gcps.py"


rule match_pair:
    input:
        first_film=film_of("fore", "film.tif"),
        second_film=film_of("aft", "film.tif"),
        first_footprint=film_of("fore", "footprint.json"),
        second_footprint=film_of("aft", "footprint.json"),
        reference_dem=of_site("reference_dem"),
    output:
        tie_points="results/pairs/{pair}/tie_points.parquet",
        summary="results/pairs/{pair}/tie_points.json",
    log:
        "logs/match_pair/{pair}.log",
    benchmark:
        "benchmarks/match_pair/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(2),
        runtime=runtime(3),
    params:
        **choices("match_pair"),
        library=house.script_digest("match_pair"),
        reference_dem_heights=of_site("reference_dem_heights"),
        names=["fore", "aft"],
        needed=is_alone,
    message:
        "Matching fore with aft of {wildcards.pair}"
    script:
        "../scripts/match_pair.py"


rule match_neighbours:
    input:
        first_film="results/scenes/{first}/film.tif",
        second_film="results/scenes/{second}/film.tif",
        first_footprint="results/scenes/{first}/footprint.json",
        second_footprint="results/scenes/{second}/footprint.json",
        reference_dem=of_site("reference_dem"),
    output:
        tie_points="results/blocks/{block}/neighbours/{first}_{second}.parquet",
        summary="results/blocks/{block}/neighbours/{first}_{second}.json",
    log:
        "logs/match_neighbours/{block}_{first}_{second}.log",
    benchmark:
        "benchmarks/match_neighbours/{block}_{first}_{second}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(2),
        runtime=runtime(3),
    params:
        **choices("match_pair"),
        library=house.script_digest("match_pair"),
        reference_dem_heights=of_site("reference_dem_heights"),
        names=["first", "second"],
        needed=False,
    message:
        "Matching {wildcards.first} with its neighbour {wildcards.second}"
    script:
        "../scripts/match_pair.py"
