"""Sheets read, wildcards constrained, and the few functions that rules share."""

from snakemake.exceptions import WorkflowError

from cosp import sheets
from cosp import workflow as house

try:
    project = sheets.load(config, file=house.config_name(workflow.configfiles))
except sheets.FaultySheets as faults:
    raise WorkflowError(str(faults)) from None


wildcard_constraints:
    site=house.any_of(project.settings["sites"]),
    scene=house.any_of(project.scenes),
    pair=house.any_of(project.pairs),
    block=house.any_of({scene.block for scene in project.scenes.values()}),
    first=house.any_of(project.scenes),
    second=house.any_of(project.scenes),
    look="fore|aft",
    aft="|_aft",


# Jobs of one machine share its memory as they share its cores, unless a limit is given; a cluster has limits of its own.
if workflow.nodes is None and "mem_mb" not in workflow.global_resources:
    workflow.register_resource("mem_mb", house.machine_memory_mb())


scattergather:
    match_tiles=house.strip_count(project, house.LARGEST_CONTROL_STRIP_MPX),
    match_dense=house.strip_count(project),


def choices(section):
    """The section of a rule in the config, as its parameters."""
    return project.settings[section]


def scene_of(wildcards):
    """Row of the scene sheet."""
    return project.scenes[wildcards.scene]


def of_scene(name):
    """Function that gives one entry of a scene's row."""
    return lambda wildcards: getattr(scene_of(wildcards), name)


def of_site(key):
    """Function that gives one entry of the site of a scene, pair or block."""
    return lambda wildcards: project.settings["sites"][
        house.site_of(project, wildcards)
    ][key]


def site_file(key):
    """Function that gives a file of the site; none where the config names none."""
    return lambda wildcards: house.site_file(
        project, house.site_of(project, wildcards), key
    )


def member(look):
    """Function that gives the scene of a pair by its look."""
    return lambda wildcards: getattr(project.pairs[wildcards.pair], look)


def shown(wildcards):
    """Scene of a pair that an orthophoto shows."""
    return member("aft" if wildcards.aft else "fore")(wildcards)


def orthophotos():
    """Orthophotos that the config wants of every pair."""
    return ["ortho.tif"] + ["ortho_aft.tif"] * project.settings["aft_orthophotos"]


def film_of(look, name):
    """Function that gives a file of the fore or aft scene of a pair."""
    return lambda wildcards: f"results/scenes/{member(look)(wildcards)}/{name}"


def cameras_of_pair(wildcards):
    """Folder of the adjusted cameras of a pair's block."""
    return f"results/blocks/{project.block_of(wildcards.pair)}/cameras"


def block_file(name):
    """Function that gives a file of a pair's block."""
    return lambda wildcards: f"results/blocks/{project.block_of(wildcards.pair)}/{name}"


def parts_of_scene(wildcards):
    """Digitised parts of a scene that are there, or that the simulator will write."""
    scene = scene_of(wildcards)
    return house.part_paths(
        scene, simulated=sheets.is_simulated(project.settings, scene.site, scene.parts)
    )


def missing_parts(wildcards):
    """Digitised parts of a scene that are not there, for its job to say so."""
    scene = scene_of(wildcards)
    return house.missing_parts(
        scene, simulated=sheets.is_simulated(project.settings, scene.site, scene.parts)
    )


def crs_of_site(wildcards):
    """Coordinate system of the products."""
    return house.site_crs(project, house.site_of(project, wildcards))


def scenes_of_block(wildcards):
    """Scenes of a block, in the order of the sheet."""
    return project.scenes_of_block(wildcards.block)


def pairs_of_block(wildcards):
    """Pairs of a block, in the order of the sheet."""
    return project.pairs_of_block(wildcards.block)


def members_of_block_pairs(wildcards):
    """Fore and aft scene of every pair of a block."""
    return [
        [project.pairs[pair].fore, project.pairs[pair].aft]
        for pair in pairs_of_block(wildcards)
    ]


def members_of_site_pairs(wildcards):
    """Fore scene, aft scene and block of every pair of a site."""
    return [
        [project.pairs[pair].fore, project.pairs[pair].aft, project.block_of(pair)]
        for pair in project.pairs_of_site(wildcards.site)
    ]


def neighbours_of_block(wildcards):
    """Frames of a block that follow each other in one camera, two by two."""
    return project.neighbours_of_block(wildcards.block)


def of_neighbours(pattern):
    """Function that gives a file of all neighbouring frames of a block."""
    return lambda wildcards: [
        pattern.format(block=wildcards.block, first=first, second=second)
        for first, second in neighbours_of_block(wildcards)
    ]


def is_alone(wildcards):
    """Whether a scene or pair has no other pair in its block, whose frames could carry it."""
    return house.is_alone(project, wildcards)


def of_block(pattern):
    """Function that gives a file of every scene of a block."""
    return lambda wildcards: expand(pattern, scene=scenes_of_block(wildcards))


def others_of_block(pattern):
    """Function that gives a file of every other scene of a scene's block."""
    return lambda wildcards: expand(
        pattern,
        scene=[
            name
            for name in project.scenes_of_block(scene_of(wildcards).block)
            if name != wildcards.scene
        ],
    )


def of_pairs_of_block(pattern):
    """Function that gives a file of every pair of a block."""
    return lambda wildcards: expand(pattern, pair=pairs_of_block(wildcards))


def of_pairs_with_dem_control(pattern):
    """Function that gives a file of every pair of a block that takes control from elevation models; none elsewhere."""
    return lambda wildcards: (
        of_pairs_of_block(pattern)(wildcards)
        if house.wants_dem_control(project, house.site_of(project, wildcards))
        else []
    )


def of_pairs_of_site(pattern):
    """Function that gives a file of every pair of a site."""
    return lambda wildcards: expand(pattern, pair=project.pairs_of_site(wildcards.site))


def of_scenes_of_site(pattern):
    """Function that gives a file of every scene of a site that is in a pair."""
    return lambda wildcards: expand(
        pattern, scene=project.scenes_of_site(wildcards.site)
    )


def of_blocks_of_site(pattern):
    """Function that gives a file of every block of a site."""
    return lambda wildcards: expand(
        pattern, block=project.blocks_of_site(wildcards.site)
    )


def blocks_to_export():
    """Blocks whose cameras the config wants in the forms of other programs."""
    return house.blocks_to_export(project)


def settings_for_page(wildcards):
    """What the quality page says was chosen."""
    return house.settings_for_page(project, wildcards.site)


def with_start_interval(given):
    """An input that dense matching needs only where the reference DEM bounds its disparities."""
    return given if choices("match_dense")["start_interval_m"] else []


# What both adjustments of a block start from.
OBSERVATIONS_OF_BLOCK = {
    "gcps": of_block("results/scenes/{scene}/gcps.parquet"),
    "footprints": of_block("results/scenes/{scene}/footprint.json"),
    "films": of_block("results/scenes/{scene}/film.json"),
    "seams": of_block("results/scenes/{scene}/seams.json"),
    "tie_points": of_pairs_of_block("results/pairs/{pair}/tie_points.parquet"),
    "neighbour_points": of_neighbours(
        "results/blocks/{block}/neighbours/{first}_{second}.parquet"
    ),
    "reference_dem": of_site("reference_dem"),
    "unstable_terrain": site_file("unstable_terrain"),
}


def memory(bytes_per_px):
    """Function that asks for memory by the size of the largest film that the job touches."""
    return lambda wildcards: house.memory_mb(
        house.largest_film_mpx(project, wildcards), bytes_per_px=bytes_per_px
    )


def runtime(us_per_px):
    """Function that asks for minutes by the size of the largest film that the job touches."""
    return lambda wildcards, threads: house.runtime_min(
        house.largest_film_mpx(project, wildcards), us_per_px=us_per_px, threads=threads
    )
