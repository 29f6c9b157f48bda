"""Dense matching beside OpenCV's StereoSGBM, on pairs with known disparity: processor time and accuracy.

    python -m tests.benchmarks.dense_matching                     # spans of 64 and 256 px
    python -m tests.benchmarks.dense_matching --spans 64 256 1400 --rounds 5 --scale 2

Relief is fractal with a few rock steps; the right picture differs in gamma, contrast and illumination, both have their
own grain, high ground is saturated snow. Every matcher runs in a process of its own, in turn, on one thread, its second
call timed; medians over the rounds. OpenCV has penalties tuned on such pairs, and its disparities get the 5 x 5 median
that ours contain, unpaid. Accuracy is over what both pictures see and is not snow, within the columns that OpenCV can
match.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from cosp.dense.coarse_to_fine import match
from cosp.dense.resampling import median_of_given
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
    right, seen = warp(ground, disparity)
    right = np.where(np.isnan(right), 0.35, right)

    def film(values, gain, gamma, fog):
        light = np.clip(values, 0, 4) ** gamma * gain + fog
        light *= 1 + 0.12 * fractal(shape, rng, 3.5, 0.002)
        grain = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 0.6)
        return np.clip(np.rint(255 * light + 3 * grain / grain.std()), 1, 255).astype(np.uint8)

    judged = seen & ~snow
    judged[:, -span:] = False
    judged[:16] = judged[-16:] = judged[:, :16] = False
    np.savez(
        path,
        left=film(ground, 0.95, 1.0, 0.02),
        right=film(right, 0.75, 1.25, 0.10),
        disparity=disparity,
        judged=judged,
    )


def matcher(method, span):
    if method == "ours":
        return lambda left, right: match(left, right, (0, span), **OURS).disparity
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


def run_once(path, method, span):
    """One matcher in this process: its processor time per pixel and its accuracy."""
    cv2.setNumThreads(1)
    with np.load(path) as pair:
        left, right, disparity, judged = (pair[name] for name in ("left", "right", "disparity", "judged"))
    work = matcher(method, span)
    work(left, right)  # compiles, touches memory
    started = time.process_time()
    found = work(left, right)
    used = time.process_time() - started
    if method != "ours":
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


def compare(span, rounds, scale, seed):
    methods = ["ours", *OPENCV] if span < 1000 else ["ours"]
    results = {method: [] for method in methods}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "pair.npz")
        make_pair(path, span, scale, seed)
        for _ in range(rounds):
            for method in methods:
                command = [sys.executable, "-m", __spec__.name, "--once", str(path), method, str(span)]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                results[method].append(json.loads(done.stdout))
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
    parser.add_argument("--once", nargs=3, metavar=("PAIR", "METHOD", "SPAN"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.once:
        print(json.dumps(run_once(chosen.once[0], chosen.once[1], int(chosen.once[2]))))
    else:
        for span in chosen.spans:
            compare(span, chosen.rounds, chosen.scale, chosen.seed)
