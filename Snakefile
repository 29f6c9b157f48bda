"""Corona Stereo Pipeline: from digitised panoramic film to coregistered elevation models."""

from snakemake.utils import min_version

min_version("9.19")


# The demo site, unless a config is given: the two are never mixed.
if "sites" not in config:

    configfile: "config/config.yaml"


report: "docs/captions/workflow.rst"


include: "rules/common.smk"
include: "rules/simulation.smk"
include: "rules/film.smk"
include: "rules/control.smk"
include: "rules/orientation.smk"
include: "rules/epipolar.smk"
include: "rules/surface.smk"
include: "rules/dem.smk"


rule all:
    default_target: True
    input:
        collect("results/sites/{site}/report.html", site=project.sites),
        collect(
            "results/pairs/{pair}/{product}",
            pair=project.pairs,
            product=["dem_sigma.tif", "quality.json", *orthophotos()],
        ),
        collect("results/blocks/{block}/exports", block=blocks_to_export()),
