"""Plain model against film fields, from noisy observations of a pair with known truth: the table of docs/adjustment.md.

    python -m tests.benchmarks.adjustment [case ...] [--seeds 1 2 3]
    python -m tests.benchmarks.adjustment --block 12 [--ties 20000] [--without-control 3]

Of several seeds, medians are printed, and the worst of the heights. --block adjusts so many successive pairs at once
and tells time and memory; --without-control takes the control of both films of one pair away.

The truth are cameras of the published parameter table; film distortion is a Gaussian random field (200 waves), no sum
of splines. Control: 3 m per horizontal axis, 4 m in height, 0.7 px; 6000 tie points of 0.4 px; reference heights of
4 m, white over cells of 300 m. Start cameras are off by 5 km and, in velocity, attitude and rates, by what the priors
say. Errors are those of the model: noise-free points all over the overlap, intersected, against the truth. Where films
step, a third row is that of an adjustment that knows where, and expects 0.3 px at joints of parts, 0.1 px of a block.
"""

import argparse
import resource
import time
from dataclasses import fields, replace

import numpy as np

from cosp.adjustment.blocks import orient_block
from cosp.adjustment.calibration import FieldChoices
from cosp.adjustment.fieldprior import Joints
from cosp.adjustment.observations import Control
from cosp.adjustment.posterior import height_sigma, place_sigma_m
from cosp.adjustment.rows import intersections, tie_rows
from tests.adjustment.simulated import (
    HALF_LENGTH_MM,
    JOINTS_MM,
    SteppedFilm,
    conjugates,
    simulate_block,
    simulate_pair,
)
from tests.adjustment.test_calibration import reference
from tests.authorities.parameter_table import PIXEL_MM, pair

CASES = {
    "1.5 px, 20 points": {"gcps": 20},
    "1.5 px, 50 points": {"gcps": 50},
    "1.5 px, 100 points": {"gcps": 100},
    "1.5 px, 500 points": {"gcps": 500},
    "1.5 px, 1000 points": {"gcps": 1000},
    "1.5 px, 5000 points": {"gcps": 5000},
    "0.8 px, 1000 points": {"distortion_px": 0.8},
    "2.5 px, 1000 points": {"distortion_px": 2.5},
    "20 % gross errors": {"gross_share": 0.2},
    "no control in 40 % of the film": {"gap": 0.4},
    "lens compensated, V/(H delta) = 0.014": {"lens": True},
    "scanner steps of 0.3 px": {"step_px": 0.3},
    "seam steps of 0.5 px": {"joint_px": 0.5},
    "pair 1117": {"name": "1117"},
}
SIGMA_OF_START = np.concatenate([np.zeros(3), [50.0, 80.0, 30.0], np.radians([0.5] * 3 + [0.05] * 3), [0.001]])


def observations(seed, *, gcps=1000, distortion_px=1.5, gap=0.0, lens=False, name="1112", **more):
    """A simulated pair with all its points as control."""
    cameras = pair(name)
    if lens:
        rows = [camera.parameters() * np.where(np.arange(13) == 9, 0.0, 1.0) for camera in cameras]
        rows = [row + np.where(np.arange(13) == 12, 0.014 - row[12], 0.0) for row in rows]
        cameras = tuple(camera.with_parameters(row) for camera, row in zip(cameras, rows, strict=True))
    simulated = simulate_pair(
        np.random.default_rng(seed), gcps=gcps, ties=6000, distortion_px=distortion_px, cameras=cameras, **more
    )
    control = []
    for parts in zip(simulated.control, simulated.checks, strict=True):
        joined = Control(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Control)))
        kept = np.abs(joined.film_mm[:, 0]) >= gap * HALF_LENGTH_MM
        control.append(Control(*(getattr(joined, f.name)[kept] for f in fields(Control))))
    return replace(simulated, control=control)


def y_parallax_px(simulated, cameras):
    """Standard deviation of what is left across the epipolar planes at noise-free points."""
    first, second, _ = conjugates(simulated.cameras, np.random.default_rng(97), 2000)
    measured = [film + field(film) for film, field in zip((first, second), simulated.distortions, strict=True)]
    ties = replace(simulated.ties, first_mm=measured[0], second_mm=measured[1], sigma_mm=np.full(len(first), PIXEL_MM))
    return float(np.std(tie_rows(intersections(cameras, ties), ties).residuals) * np.sqrt(2.0))


def known_joints(case):
    """Where the films of a case step, for an adjustment that is to estimate that; None where they do not."""
    if "joint_px" in case:
        return [Joints(places, (0.3 * PIXEL_MM,) * len(places)) for places in JOINTS_MM]
    if "step_px" in case:
        places = tuple(np.arange(-320.0, 321.0, SteppedFilm.every_mm))
        return [Joints(places, (0.0,) * len(places), 0.1 * PIXEL_MM)] * 2
    return None


def compare(seed, case):
    """Rows of the table: plain, field and, where films step, field with steps."""
    simulated = observations(seed, **case)
    rng = np.random.default_rng(seed + 100)
    off = SIGMA_OF_START * rng.normal(size=(2, 13)) + np.concatenate([[4000.0, -3000.0, 1000.0], np.zeros(10)])
    start = [camera.with_parameters(camera.parameters() + o) for camera, o in zip(simulated.cameras, off, strict=True)]
    joints = known_joints(case)
    for steps in [None] if joints is None else [None, joints]:
        began = time.process_time()
        block = orient_block(
            start,
            simulated.control,
            [simulated.ties],
            film_distortion_mm=0.010,
            tie_distortion_mm=0.005,
            gate_sigma=4.0,
            field=FieldChoices(17.5, 14.0, (25.0, 40.0, 60.0, 100.0)),
            reference=reference(simulated),
            joints=steps,
        )
        seconds = time.process_time() - began
        if steps is None:
            yield row("plain", block.plain, simulated, seconds)
        yield row("field" if steps is None else "field, steps", block.adjustment, simulated, seconds)
        prior = block.calibration.prior
        print(f"<!-- {prior.length_mm:.0f} mm, {prior.amplitude_mm / PIXEL_MM:.2f} px -->", flush=True)


def row(model, adjustment, simulated, seconds):
    """What is told of an adjustment."""
    cameras = adjustment.cameras
    residuals = [
        ((points.film_mm - camera.project(points.ground_m)) / PIXEL_MM)[weights > 0]
        for camera, points, weights in zip(cameras, simulated.control, adjustment.control_weights, strict=True)
    ]
    return {
        "model": model,
        "errors_m": simulated.model_errors_m(cameras),
        "y_parallax_px": y_parallax_px(simulated, cameras),
        "residual_px": float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))),
        "sigma_naught": adjustment.sigma_naught,
        "seconds": seconds,
    }


def block_of(seed, pairs, ties, without):
    """Adjust successive pairs; a row per pair, then time and memory."""
    rng = np.random.default_rng(seed)
    simulated = simulate_block(rng, pairs=pairs, gcps=1000, ties=ties, neighbour_ties=500)
    if without is not None:
        simulated = simulated.without_control([2 * without - 2, 2 * without - 1])
    began, clock = time.process_time(), time.perf_counter()
    found = orient_block(
        simulated.start(rng),
        simulated.control,
        simulated.ties,
        film_distortion_mm=0.010,
        tie_distortion_mm=0.005,
        gate_sigma=4.0,
        field=FieldChoices(17.5, 14.0, (25.0, 40.0, 60.0, 100.0)),
        reference=reference(simulated),
        film_groups=simulated.film_groups,
        place_sigmas_m=[1000.0] * (2 * pairs),
    )
    seconds, elapsed = time.process_time() - began, time.perf_counter() - clock
    of_it = {"covariance": found.adjustment.covariance, "calibration": found.calibration, "height_m": 1500.0}
    print("| pair | east m | north m | up m | heights over their sigma | sigma of the place, east and north m |")
    print("|---|---|---|---|---|---|")
    for pair_number in range(pairs):
        fore, aft = 2 * pair_number, 2 * pair_number + 1
        cameras = found.adjustment.cameras
        errors, film = simulated.errors_m(cameras, pair_number)
        sigma = height_sigma(cameras, fore, aft, film_sigma_mm=0.0, step_mm=10.0, **of_it)
        numbers = " | ".join(f"{error:.2f}" for error in np.sqrt((errors**2).mean(axis=0)))
        ratio = np.sqrt(np.mean((errors[:, 2] / sigma.at(film)) ** 2))
        east, north = place_sigma_m(cameras, fore, **of_it)
        print(f"| {pair_number + 1} | {numbers} | {ratio:.2f} | {east:.2f} {north:.2f} |", flush=True)
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    prior = found.calibration.prior
    print(f"{seconds:.0f} s of a processor, {elapsed:.0f} s by the clock, {memory_gb:.1f} GB; {prior}")
    print(found.calibration.scales)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(CASES).replace('%', '%%')}; all if left out")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--block", type=int, default=None, help="number of pairs")
    parser.add_argument("--ties", type=int, default=20000, help="of each pair of a block")
    parser.add_argument("--without-control", type=int, default=None, help="number of a pair of the block")
    chosen = parser.parse_args()
    if chosen.block:
        block_of(chosen.seeds[0], chosen.block, chosen.ties, chosen.without_control)
        return
    head = ["case", "model", "east m", "north m", "up m", "y-parallax px", "residual of control px", "sigma naught"]
    print(f"| {' | '.join([*head, 'processor s'])} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in chosen.cases or CASES:
        for rows in zip(*(list(compare(seed, CASES[name])) for seed in chosen.seeds), strict=True):
            east, north, up = np.median([row["errors_m"] for row in rows], axis=0)
            worst = max(row["errors_m"][2] for row in rows)
            height = f"{up:.2f}" if len(rows) == 1 else f"{up:.2f}, at most {worst:.2f}"
            parallax, residual, sigma, seconds = (
                np.median([row[key] for row in rows])
                for key in ("y_parallax_px", "residual_px", "sigma_naught", "seconds")
            )
            model = rows[0]["model"]
            last = "" if model == "plain" else f"{seconds:.0f}"
            numbers = f"{east:.2f} | {north:.2f} | {height} | {parallax:.2f} | {residual:.2f} | {sigma:.2f}"
            print(f"| {name} | {model} | {numbers} | {last} |", flush=True)


if __name__ == "__main__":
    main()
