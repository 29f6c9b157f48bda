"""Kill the demo again and again, go on each time, and compare the products with those of an undisturbed run.

    python tests/workflow/kill_drill.py --kills 10 --seed 1 [--pixel-um 56] [--folder DIR]

Each kill takes the whole process group (SIGKILL) at a random moment. Then `--unlock` and the same command again.
Exits with 1 when a product differs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HOME = Path(__file__).resolve().parents[2]
# Files that say when or how quickly something was done.
TELLING_TIME = ("*.log", "*.jsonl")


def start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Snakemake over the folder's site, in a process group of its own."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), "--cores", "2"]
    command += ["--configfile", str(folder / "config.yaml"), "--directory", str(folder), *arguments]
    with (folder / "run.log").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, start_new_session=True)


def describe(folder: Path, pixel_um: float) -> None:
    """Config and sheets of the simulated site."""
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "cosp.simulation", "--directory", str(folder), "--name", "drill"]
    subprocess.run([*command, "--pixel-um", str(pixel_um)], check=True)


def checksums(folder: Path) -> dict[str, str]:
    """Checksum of every product under results and resources."""
    found = {}
    for root in ("results", "resources"):
        for path in sorted((folder / root).rglob("*")):
            if path.is_file() and not any(path.match(pattern) for pattern in TELLING_TIME):
                found[path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def undisturbed(folder: Path) -> float:
    """Run to the end; seconds it took."""
    began = time.monotonic()
    if start(folder).wait() != 0:
        sys.exit(f"the undisturbed run failed, see {folder / 'run.log'}")
    return time.monotonic() - began


def disturbed(folder: Path, *, kills: int, seconds: float, chance: random.Random) -> int:
    """Run with kills at random moments, then to the end; number of kills that met a running workflow."""
    met = 0
    for number in range(kills):
        running = start(folder)
        # Late enough for jobs to run, early enough that all kills fit into one run's time.
        moment = chance.uniform(5.0, 5.0 + 2.0 * seconds / kills)
        try:
            running.wait(timeout=moment)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
            met += 1
        unlocked = start(folder, "--unlock").wait()
        print(f"kill {number + 1}/{kills} after {moment:.0f} s, unlock {unlocked}", flush=True)
    if start(folder).wait() != 0:
        sys.exit(f"the disturbed run did not come to its end, see {folder / 'run.log'}")
    return met


def main() -> int:
    """Run the drill; 0 when all products are the same."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pixel-um", type=float, default=56.0)
    parser.add_argument("--folder", type=Path, help="kept afterwards; left out, a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        quiet, drilled = folder / "quiet", folder / "drilled"
        for each in (quiet, drilled):
            describe(each, options.pixel_um)
        seconds = undisturbed(quiet)
        print(f"undisturbed run: {seconds:.0f} s", flush=True)
        met = disturbed(drilled, kills=options.kills, seconds=seconds, chance=random.Random(options.seed))
        ours, theirs = checksums(quiet), checksums(drilled)
        differing = sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name))
    print(f"{met} kills met a running workflow; {len(ours)} products, {len(differing)} differ")
    for name in differing:
        print(f"  {name}: {'differs' if name in ours and name in theirs else 'only in one run'}")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
