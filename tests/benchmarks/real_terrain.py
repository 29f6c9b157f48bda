"""Process a pair simulated over a real DEM and hold its heights against the truth.

    COSP_TEST_DATA=... python tests/benchmarks/real_terrain.py --pixel-um 28 [--folder DIR]
    COSP_TEST_DATA=... python tests/benchmarks/real_terrain.py --pixel-um 7 --area-of-interest-km 20

At 28 um the whole film is matched and held to the figures of the demo: heights within 1.2 px before and 0.7 px after
coregistration, a pixel being the height that one pixel of parallax is worth. At 7 um (106 000 x 8 000 px) an area of
interest is matched and held to the figures that Ghuffar et al. (2022) published: 7 m before, 3.5 m after. A second
call goes on from where the first one stopped. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HOME = Path(__file__).resolve().parents[2]
PUBLISHED_M = (7.0, 3.5)
DEMO_PX = (1.2, 0.7)


def make(folder: Path, dem: Path, options: argparse.Namespace) -> None:
    """Write config and sheets of the site, once."""
    if (folder / "config.yaml").exists():
        return
    command = [sys.executable, "-m", "cosp.simulation", "--directory", str(folder), "--name", "tyrol"]
    command += ["--dem", str(dem), "--dem-heights", "egm96", "--pixel-um", str(options.pixel_um)]
    command += ["--seed", str(options.seed), "--distortion-px", "1.5"]
    if options.area_of_interest_km:
        command += ["--area-of-interest-km", str(options.area_of_interest_km)]
    subprocess.run(command, check=True)


def process(folder: Path) -> None:
    """Run the workflow to its end."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), "--cores", "2"]
    subprocess.run([*command, "--configfile", str(folder / "config.yaml"), "--directory", str(folder)], check=True)


def main() -> int:
    """Read the command line; 0 when every figure is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixel-um", type=float, default=28.0)
    parser.add_argument("--area-of-interest-km", type=float, default=None)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=None, help="where the site lies; kept")
    options = parser.parse_args()
    dem = Path(os.environ.get("COSP_TEST_DATA", "")) / "innsbruck_west" / "aw3d30.tif"
    if not dem.exists():
        print("skipped: COSP_TEST_DATA does not hold innsbruck_west/aw3d30.tif")
        return 0
    folder = options.folder or Path(tempfile.mkdtemp(prefix="cosp-terrain-"))
    make(folder, dem, options)
    process(folder)

    missed = 0
    for path in sorted((folder / "results" / "pairs").glob("*/quality.json")):
        quality = json.loads(path.read_text(encoding="utf-8"))
        pixel_m = quality["height_per_px_m"]
        print(f"{path.parent.name}: sigma naught {quality['sigma_naught_px']:.2f} px, {quality['y_parallax']}")
        limits = PUBLISHED_M if options.pixel_um <= 7 else tuple(share * pixel_m for share in DEMO_PX)
        for when, limit in zip(("before", "after"), limits, strict=True):
            found = quality["check"][when]
            met = found["nmad"] <= limit
            missed += not met
            print(
                f"{when} coregistration, against the truth: median {found['median']:.2f} m, NMAD {found['nmad']:.2f} m "
                f"({found['nmad'] / pixel_m:.2f} px), limit {limit:.2f} m, completeness {found['completeness']:.3f}: "
                f"{'met' if met else 'MISSED'}"
            )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
