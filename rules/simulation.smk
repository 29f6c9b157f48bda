rule simulate_site:
    output:
        reference_dem="resources/simulated/{site}/reference_dem.tif",
        reference_image="resources/simulated/{site}/reference_image.tif",
        unstable_terrain="resources/simulated/{site}/unstable_terrain.gpkg",
        terrain="resources/simulated/{site}/truth/terrain.tif",
        terrain_modern="resources/simulated/{site}/truth/terrain_modern.tif",
        scenery="resources/simulated/{site}/truth/scenery.tif",
        truth="resources/simulated/{site}/truth/site.json",
        scenes="resources/simulated/{site}/scenes.tsv",
        pairs="resources/simulated/{site}/pairs.tsv",
        config="resources/simulated/{site}/config.yaml",
    log:
        "logs/simulate_site/{site}.log",
    benchmark:
        "benchmarks/simulate_site/{site}.jsonl"
    # Files of a site that is not to be simulated are its user's own, wherever they lie.
    wildcard_constraints:
        site=house.any_of(choices("simulate_site")),
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=3000,
        runtime=60,
    params:
        library=house.script_digest("simulate_site"),
        options=lambda wildcards: choices("simulate_site")[wildcards.site],
    message:
        "Making the terrain, reference and orbit of {wildcards.site}"
    script:
        "../scripts/simulate_site.py"


rule expose_film:
    input:
        truth="resources/simulated/{site}/truth/site.json",
        terrain="resources/simulated/{site}/truth/terrain.tif",
        scenery="resources/simulated/{site}/truth/scenery.tif",
    output:
        parts=expand(
            "resources/simulated/{{site}}/parts/{{scene}}_{letter}.tif",
            letter=house.PART_LETTERS,
        ),
        truth="resources/simulated/{site}/truth/{scene}.json",
    log:
        "logs/expose_film/{site}_{scene}.log",
    benchmark:
        "benchmarks/expose_film/{site}_{scene}.jsonl"
    # Files of a site that is not to be simulated are its user's own, wherever they lie.
    wildcard_constraints:
        site=house.any_of(choices("simulate_site")),
    conda:
        "../envs/cosp.yaml"
    threads: 2
    resources:
        mem_mb=memory(4),
        runtime=runtime(4),
    params:
        library=house.script_digest("expose_film"),
    message:
        "Exposing {wildcards.scene}"
    script:
        "../scripts/expose_film.py"
