rule rectify:
    input:
        cameras=cameras_of_pair,
        fore_film=film_of("fore", "film.tif"),
        aft_film=film_of("aft", "film.tif"),
        reference_dem=of_site("reference_dem"),
        area_of_interest=site_file("area_of_interest"),
    output:
        rectification="results/pairs/{pair}/rectification.json",
    log:
        "logs/rectify/{pair}.log",
    benchmark:
        "benchmarks/rectify/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(2),
        runtime=runtime(0.3),
    params:
        **choices("rectify"),
        y_parallax=choices("measure_y_parallax"),
        library=house.script_digest("rectify"),
        fore=member("fore"),
        aft=member("aft"),
        reference_dem_heights=of_site("reference_dem_heights"),
    message:
        "Fitting the epipolar geometry of {wildcards.pair}"
    script:
        "../scripts/rectify.py"


rule resample_epipolar:
    input:
        fore_film=film_of("fore", "film.tif"),
        aft_film=film_of("aft", "film.tif"),
        rectification="results/pairs/{pair}/rectification.json",
    output:
        fore="results/pairs/{pair}/fore_epipolar.tif",
        aft="results/pairs/{pair}/aft_epipolar.tif",
    log:
        "logs/resample_epipolar/{pair}.log",
    benchmark:
        "benchmarks/resample_epipolar/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(3),
        runtime=runtime(0.3),
    params:
        **choices("resample_epipolar"),
        library=house.script_digest("resample_epipolar"),
    message:
        "Resampling {wildcards.pair} along epipolar lines"
    script:
        "../scripts/resample_epipolar.py"


rule measure_y_parallax:
    input:
        fore="results/pairs/{pair}/fore_epipolar.tif",
        aft="results/pairs/{pair}/aft_epipolar.tif",
        rectification="results/pairs/{pair}/rectification.json",
    output:
        y_parallax="results/pairs/{pair}/y_parallax.tif",
        summary="results/pairs/{pair}/y_parallax.json",
    log:
        "logs/measure_y_parallax/{pair}.log",
    benchmark:
        "benchmarks/measure_y_parallax/{pair}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(2),
        runtime=runtime(0.5),
    params:
        **choices("measure_y_parallax"),
        library=house.script_digest("measure_y_parallax"),
    message:
        "Measuring the y-parallax of {wildcards.pair}"
    script:
        "../scripts/measure_y_parallax.py"
