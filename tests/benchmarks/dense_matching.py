"""Dense matching beside OpenCV's StereoSGBM and pandora, on pairs with known disparity: processor time and accuracy.

    python -m tests.benchmarks.dense_matching                     # spans of 64 and 256 px
    python -m tests.benchmarks.dense_matching --spans 64 256 1400 --rounds 5 --scale 2
    python -m tests.benchmarks.dense_matching --spans 64 --pandora /elsewhere/bin/python

Relief is fractal with a few rock steps; the right picture differs in gamma, contrast and illumination, both have their
own grain, high ground is saturated snow. Every matcher runs in a process of its own, in turn, on one thread, its second
call timed; medians over the rounds. OpenCV has penalties tuned on such pairs, and its disparities get the 5 x 5 median
that ours contain, unpaid. Pandora with libsgm (extra `oracle`) takes part where this or another interpreter has it, on
the first rows alone. "y-parallax" is ours on the same pair with rows that do not match by 0.8 px (standard deviation),
folded into the resampling. Accuracy is over what both pictures see and is not snow, within the columns that OpenCV can
match.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from cosp.dense.coarse_to_fine import match
from cosp.dense.resampling import SmoothField, median_of_given
from cosp.geometry.statistics import nmad
from tests.dense.synthetic import texture, warp

SHAPES = {64: (1200, 1600), 256: (1200, 2400), 1400: (1600, 5600)}
OPENCV = {  # block size, penalties per pixel of the block, cap of the prefilter
    "SGBM": ("MODE_SGBM", 7, 4, 64, 63),
    "HH": ("MODE_HH", 9, 4, 96, 31),
}
OURS = {
    "small_step": 24,
    "large_step": 64,
    "least_texture_sd": 2.0,
    "saturated_from": 250,
    "least_correlation": 0.35,
    "least_uniqueness": 0.25,
    "largest_speckle_px": 100,
    "speckle_step_px": 1.5,
    "threads": 1,
}
PANDORA = (7, 12, 80)  # window, penalties
PANDORA_ROWS = 300
Y_PARALLAX_SD_PX = 0.8
NODES_EVERY_PX = 32
COLUMNS = ("method", "ns/px", "time/ours", "density", "bad1 %", "bad3 %", "NMAD px")


def fractal(shape, rng, exponent, coarsest=1.0):
    """Random field whose power falls with frequency to the given exponent, of standard deviation one."""
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None])
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(spectrum * frequency ** (-exponent / 2) * (frequency < coarsest), s=shape)
    return field / field.std()


def make_pair(path, span, scale, seed):
    """Write left, right, disparity and the mask of what is judged."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n * scale**0.5) for n in SHAPES[span])
    relief = fractal(shape, rng, 4.2) + 0.01 * fractal(shape, rng, 2.6, 0.06)
    relief = (relief - relief.min()) / np.ptp(relief)
    disparity = 2 + relief * (span - 8)
    disparity += 3 * cv2.GaussianBlur((fractal(shape, rng, 3.0, 0.02) > 1.2).astype(float), (0, 0), 1.5)
    down, across = np.gradient(disparity)
    shade = np.clip((0.66 - 0.6 * across - 0.45 * down) / np.sqrt(1 + across**2 + down**2), 0.05, 1)
    snow = relief > 0.85
    contrast = 0.06 * np.exp(0.6 * fractal(shape, rng, 3.2, 0.02))  # scree, grass, bare ground
    albedo = 0.42 + 0.08 * fractal(shape, rng, 3.0, 0.05) + contrast * texture(shape, rng, finest_px=0.7)
    ground = np.where(snow, 1.3, np.clip(albedo, 0.05, 1.2)) * (0.25 + 0.75 * shade)
    ground = cv2.GaussianBlur(ground, (0, 0), 0.6)
    by_right = fractal(shape, rng, 4.0, 0.004)
    by_right *= Y_PARALLAX_SD_PX / by_right.std()
    columns = np.arange(shape[1])
    by_left = np.array([np.interp(columns + d, columns, line) for d, line in zip(disparity, by_right, strict=True)])
    right, seen = warp(ground, disparity)
    moved, _ = warp(ground, disparity, y_parallax=by_right)
    right, moved = (np.where(np.isnan(picture), 0.35, picture) for picture in (right, moved))

    lights = [1 + 0.12 * fractal(shape, rng, 3.5, 0.002) for _ in range(2)]

    def film(values, gain, gamma, fog, light_falls):
        light = (np.clip(values, 0, 4) ** gamma * gain + fog) * light_falls
        grain = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 0.6)
        return np.clip(np.rint(255 * light + 3 * grain / grain.std()), 1, 255).astype(np.uint8)

    judged = seen & ~snow
    judged[:, -span:] = False
    judged[:16] = judged[-16:] = judged[:, :16] = False
    np.savez(
        path,
        left=film(ground, 0.95, 1.0, 0.02, lights[0]),
        right=film(right, 0.75, 1.25, 0.10, lights[1]),
        moved=film(moved, 0.75, 1.25, 0.10, lights[1]),
        y_parallax=by_left[::NODES_EVERY_PX, ::NODES_EVERY_PX].astype(np.float32),
        disparity=disparity,
        judged=judged,
    )


def matcher(method, span, y_parallax):
    if method == "ours":
        return lambda left, right: match(left, right, (0, span), **OURS).disparity
    if method == "y-parallax":
        field = SmoothField(y_parallax, 0.0, 0.0, NODES_EVERY_PX, NODES_EVERY_PX)
        return lambda left, right: match(left, right, (0, span), y_parallax=field, **OURS).disparity
    if method == "pandora":
        return lambda left, right: by_pandora(left, right, span)
    mode, block, small, large, cap = OPENCV[method]
    engine = cv2.StereoSGBM_create(
        minDisparity=-span,
        numDisparities=span,
        blockSize=block,
        P1=small * block**2,
        P2=large * block**2,
        disp12MaxDiff=1,
        preFilterCap=cap,
        mode=getattr(cv2, f"STEREO_SGBM_{mode}"),
    )

    def run(left, right):
        found = engine.compute(left, right).astype(np.float32) / -16
        found[found > span] = np.nan
        return found

    return run


def by_pandora(left, right, span):
    """Census and semi-global matching of pandora; its disparity has our sign."""
    import pandora
    import rasterio
    from pandora.check_configuration import check_conf
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine

    window, small, large = PANDORA
    with tempfile.TemporaryDirectory() as folder:
        pictures = {}
        for name, values, limits in (("left", left, [0, span]), ("right", right, [-span, 0])):
            path = Path(folder, f"{name}.tif")
            profile = {"height": left.shape[0], "width": left.shape[1], "count": 1, "dtype": "float32"}
            with rasterio.open(path, "w", driver="GTiff", **profile) as file:
                file.write(values.astype(np.float32), 1)
            pictures[name] = {"img": str(path), "disp": limits, "nodata": -9999}
        penalty = {"penalty_method": "sgm_penalty", "P1": small, "P2": large}
        steps = {
            "matching_cost": {"matching_cost_method": "census", "window_size": window, "subpix": 1},
            "optimization": {"optimization_method": "sgm", "overcounting": False, "penalty": penalty},
            "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
            "refinement": {"refinement_method": "vfit"},
            "validation": {"validation_method": "cross_checking_fast", "cross_checking_threshold": 1.0},
        }
        pandora.import_plugin()
        machine = PandoraMachine()
        read = {"left": pictures["left"], "right": {k: pictures["right"][k] for k in ("img", "nodata")}}
        configuration = check_conf({"input": read, "pipeline": steps}, machine)
        datasets = [create_dataset_from_inputs(pictures[name]) for name in ("left", "right")]
        found, _ = pandora.run(machine, *datasets, configuration)
    disparity = found["disparity_map"].values.astype(np.float32)
    disparity[found["validity_mask"].values & (1 << 8 | 1 << 9) != 0] = np.nan
    return disparity


def run_once(path, method, span):
    """One matcher in this process: its processor time per pixel and its accuracy."""
    cv2.setNumThreads(1)
    with np.load(path) as pair:
        names = ("left", "moved" if method == "y-parallax" else "right", "disparity", "judged")
        rows = PANDORA_ROWS if method == "pandora" else None
        left, right, disparity, judged = (np.ascontiguousarray(pair[name][:rows]) for name in names)
        work = matcher(method, span, pair["y_parallax"])
    if method == "pandora":
        work(left[:50], right[:50])
    else:
        work(left, right)  # compiles, touches memory
    started = time.process_time()
    found = work(left, right)
    used = time.process_time() - started
    if method in ("pandora", *OPENCV):
        found = median_of_given(found)
    given = judged & np.isfinite(found)
    error = (found - disparity)[given]
    return {
        "ns": 1e9 * used / left.size,
        "density": 100 * given.sum() / judged.sum(),
        "bad1": 100 * (np.abs(error) > 1).mean(),
        "bad3": 100 * (np.abs(error) > 3).mean(),
        "nmad": nmad(error),
    }


def compare(span, rounds, scale, seed, pandora):
    methods = ["ours", "y-parallax", *OPENCV] if span < 1000 else ["ours", "y-parallax"]
    if pandora and span < 100:
        methods.append("pandora")
    results = {method: [] for method in methods}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "pair.npz")
        make_pair(path, span, scale, seed)
        for _ in range(rounds):
            for method in methods:
                program = pandora if method == "pandora" else sys.executable
                command = [program, "-m", __spec__.name, "--once", str(path), method, str(span)]
                one = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
                done = subprocess.run(command, capture_output=True, text=True, check=True, env=one)
                results[method].append(json.loads(done.stdout.splitlines()[-1]))
    print(f"\nspan {span} px, {rounds} rounds, scale {scale}, seed {seed}")
    print("".join(f"{name:>11}" for name in COLUMNS))
    ours = np.median([r["ns"] for r in results["ours"]])
    for method, found in results.items():
        middle = {key: float(np.median([r[key] for r in found])) for key in found[0]}
        figures = (middle["ns"], middle["ns"] / ours, *(middle[k] for k in ("density", "bad1", "bad3", "nmad")))
        print(
            f"{method:>11}" + "".join(f"{value:>11.{n}f}" for value, n in zip(figures, (0, 2, 2, 2, 2, 3), strict=True))
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spans", type=int, nargs="+", default=[64, 256], choices=sorted(SHAPES))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of pixels")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pandora", metavar="PYTHON", help="interpreter that has pandora and libsgm")
    parser.add_argument("--once", nargs=3, metavar=("PAIR", "METHOD", "SPAN"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.once:
        print(json.dumps(run_once(chosen.once[0], chosen.once[1], int(chosen.once[2]))))
    else:
        for span in chosen.spans:
            compare(span, chosen.rounds, chosen.scale, chosen.seed, chosen.pandora)
