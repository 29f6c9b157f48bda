rule match_dense:
    input:
        fore="results/pairs/{pair}/fore_epipolar.tif",
        aft="results/pairs/{pair}/aft_epipolar.tif",
        y_parallax="results/pairs/{pair}/y_parallax.tif",
        rectification="results/pairs/{pair}/rectification.json",
        cameras=with_start_interval(cameras_of_pair),
        reference_dem=with_start_interval(of_site("reference_dem")),
        unstable_terrain=with_start_interval(site_file("unstable_terrain")),
    output:
        disparity=temp("results/pairs/{pair}/disparity/{scatteritem}.npy"),
        validity=temp("results/pairs/{pair}/validity/{scatteritem}.npy"),
    log:
        "logs/match_dense/{pair}_{scatteritem}.log",
    benchmark:
        "benchmarks/match_dense/{pair}_{scatteritem}.jsonl"
    conda:
        "../envs/cosp.yaml"
    # Strips side by side keep cores busier than threads within one, which wait while it starts, reads and writes.
    threads: 1
    resources:
        mem_mb=memory(3),
        runtime=runtime(1),
    params:
        **choices("match_dense"),
        scatteritem=lambda wildcards: wildcards.scatteritem,
        library=house.script_digest("match_dense"),
        reference_dem_heights=of_site("reference_dem_heights"),
        fore=member("fore"),
        aft=member("aft"),
    message:
        "Dense matching of {wildcards.pair}, strip {wildcards.scatteritem}"
    script:
        "../scripts/match_dense.py"


rule merge_disparity:
    input:
        fore="results/pairs/{pair}/fore_epipolar.tif",
        disparity=gather.match_dense(
            "results/pairs/{{pair}}/disparity/{scatteritem}.npy"
        ),
        validity=gather.match_dense("results/pairs/{{pair}}/validity/{scatteritem}.npy"),
    output:
        disparity="results/pairs/{pair}/disparity.tif",
        validity="results/pairs/{pair}/validity.tif",
        summary="results/pairs/{pair}/disparity.json",
        figure=report(
            "results/pairs/{pair}/disparity.png",
            caption="../docs/captions/disparity.rst",
            category="Matching",
            labels={"pair": "{pair}", "figure": "disparity and confidence"},
        ),
    log:
        "logs/merge_disparity/{pair}.log",
    benchmark:
        "benchmarks/merge_disparity/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(1),
        runtime=runtime(0.1),
    params:
        library=house.script_digest("merge_disparity"),
    message:
        "Joining the disparity of {wildcards.pair}"
    script:
        "../scripts/merge_disparity.py"


rule triangulate:
    input:
        disparity="results/pairs/{pair}/disparity.tif",
        y_parallax="results/pairs/{pair}/y_parallax.tif",
        rectification="results/pairs/{pair}/rectification.json",
        cameras=cameras_of_pair,
    output:
        ray_gap="results/pairs/{pair}/ray_gap.tif",
        summary="results/pairs/{pair}/points.json",
    log:
        "logs/triangulate/{pair}.log",
    benchmark:
        "benchmarks/triangulate/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(1),
        runtime=runtime(0.3),
    params:
        **choices("triangulate"),
        library=house.script_digest("triangulate"),
        fore=member("fore"),
        aft=member("aft"),
    message:
        "Intersecting conjugate rays of {wildcards.pair}"
    script:
        "../scripts/triangulate.py"


rule grid_dem:
    input:
        disparity="results/pairs/{pair}/disparity.tif",
        validity="results/pairs/{pair}/validity.tif",
        y_parallax="results/pairs/{pair}/y_parallax.tif",
        rectification="results/pairs/{pair}/rectification.json",
        summary="results/pairs/{pair}/points.json",
        cameras=cameras_of_pair,
        height_sigma=block_file("height_sigma"),
    output:
        dem="results/pairs/{pair}/dem.tif",
        sigma="results/pairs/{pair}/dem_sigma.tif",
    log:
        "logs/grid_dem/{pair}.log",
    benchmark:
        "benchmarks/grid_dem/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(4),
        runtime=runtime(0.3),
    params:
        **choices("grid_dem"),
        library=house.script_digest("grid_dem"),
        crs=crs_of_site,
        resolution_m=of_site("dem_resolution_m"),
        ray_spacing_mm=choices("triangulate")["ray_spacing_mm"],
        ray_error_px=choices("triangulate")["ray_error_px"],
        pair=lambda wildcards: wildcards.pair,
        fore=member("fore"),
        aft=member("aft"),
    message:
        "Gridding the heights of {wildcards.pair}"
    script:
        "../scripts/grid_dem.py"


rule orthorectify:
    input:
        film=lambda wildcards: f"results/scenes/{shown(wildcards)}/film.tif",
        cameras=cameras_of_pair,
        reference_dem=of_site("reference_dem"),
        dem="results/pairs/{pair}/dem.tif",
    output:
        ortho="results/pairs/{pair}/ortho{aft}.tif",
    log:
        "logs/orthorectify/{pair}{aft}.log",
    benchmark:
        "benchmarks/orthorectify/{pair}{aft}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(1),
        runtime=runtime(0.3),
    params:
        **choices("orthorectify"),
        reference_dem_heights=of_site("reference_dem_heights"),
        library=house.script_digest("orthorectify"),
        scene=shown,
    message:
        "Orthorectifying {params.scene} of {wildcards.pair}"
    script:
        "../scripts/orthorectify.py"
