rule stitch:
    input:
        parts=parts_of_scene,
    output:
        seams="results/scenes/{scene}/seams.json",
        figure="results/scenes/{scene}/seams.png",
    log:
        "logs/stitch/{scene}.log",
    benchmark:
        "benchmarks/stitch/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(2),
        runtime=runtime(0.2),
    params:
        **choices("stitch"),
        library=house.script_digest("stitch"),
        missing=missing_parts,
        pixel_um=of_scene("pixel_um"),
    message:
        "Joining the parts of {wildcards.scene}"
    script:
        "../scripts/stitch.py"


rule trace_stripes:
    input:
        parts=parts_of_scene,
        seams="results/scenes/{scene}/seams.json",
    output:
        exposure="results/scenes/{scene}/exposure.json",
        stripes="results/scenes/{scene}/stripes.parquet",
    log:
        "logs/trace_stripes/{scene}.log",
    benchmark:
        "benchmarks/trace_stripes/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(2),
        runtime=runtime(0.2),
    params:
        **choices("trace_stripes"),
        library=house.script_digest("trace_stripes"),
        camera=of_scene("camera"),
        pixel_um=of_scene("pixel_um"),
    message:
        "Finding exposed area and stripes of {wildcards.scene}"
    script:
        "../scripts/trace_stripes.py"


rule correct_bending:
    input:
        parts=parts_of_scene,
        seams="results/scenes/{scene}/seams.json",
        exposure="results/scenes/{scene}/exposure.json",
        stripes="results/scenes/{scene}/stripes.parquet",
    output:
        film=temp("results/scenes/{scene}/straight.tif"),
        summary="results/scenes/{scene}/straight.json",
        figure="results/scenes/{scene}/bending.png",
    log:
        "logs/correct_bending/{scene}.log",
    benchmark:
        "benchmarks/correct_bending/{scene}.jsonl"
    conda:
        "../envs/cosp.yaml"
    threads: 1
    resources:
        mem_mb=memory(3),
        runtime=runtime(0.3),
    params:
        **choices("correct_bending"),
        library=house.script_digest("correct_bending"),
        look=of_scene("look"),
        camera=of_scene("camera"),
    message:
        "Straightening {wildcards.scene}"
    script:
        "../scripts/correct_bending.py"
