"""A pair with known truth: the paper's cameras, hilly ground, smooth film distortion, noise, gross errors."""

from dataclasses import dataclass

import numpy as np

from cosp.adjustment.observations import Control, Ties
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.rays import meet
from tests.authorities.parameter_table import PIXEL_MM, pair

HALF_LENGTH_MM, HALF_WIDTH_MM = 342.0, 26.5
MATCH_PX, TIE_PX = 0.7, 0.4
GROUND_M, HEIGHT_M = 3.0, 4.0


class FilmDistortion:
    """A smooth Gaussian field of given rms over the film, 60 mm long and 40 mm wide in its correlation."""

    waves = 200

    def __init__(self, rng, rms_px):
        self.frequency = rng.normal(size=(2, self.waves, 2)) / [60.0, 40.0]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (2, self.waves))
        self.amplitude_mm = rms_px * PIXEL_MM * np.sqrt(2.0 / self.waves)

    def __call__(self, film_mm):
        waves = [np.cos(film_mm @ k.T + phase).sum(-1) for k, phase in zip(self.frequency, self.phase, strict=True)]
        return self.amplitude_mm * np.stack(waves, axis=-1)


def terrain_m(ground):
    """Ellipsoidal heights, 700 m about 1500 m."""
    east, north = ground[..., 0], ground[..., 1]
    return 1500.0 + 400.0 * np.sin(east / 9e3) * np.cos(north / 7e3) + 300.0 * np.sin(east / 31e3 + 1.0)


def on_terrain(camera, film_mm):
    ground = camera.locate(film_mm, 1500.0)
    for _ in range(12):
        ground = camera.locate(film_mm, terrain_m(ground))
    return ground


@dataclass(frozen=True)
class SimulatedPair:
    cameras: tuple[PanoramicCamera, PanoramicCamera]
    distortions: tuple[FilmDistortion, FilmDistortion]
    control: list[Control]
    checks: list[Control]
    gross: list[np.ndarray]
    ties: Ties

    def start(self, off_m=(4000.0, -3000.0, 1000.0)):
        """Start cameras that are off in position."""
        off = np.concatenate([off_m, np.zeros(10)])
        return [camera.with_parameters(camera.parameters() + off) for camera in self.cameras]

    def model_errors_m(self, adjusted, count=2000):
        """RMS east, north, up of noise-free film points intersected with adjusted cameras, against the truth."""
        rng = np.random.default_rng(99)
        first, second, ground = conjugates(self.cameras, rng, count)
        fore, aft = (
            camera.rays(film + distortion(film))
            for camera, film, distortion in zip(adjusted, (first, second), self.distortions, strict=True)
        )
        found, _ = meet(fore, aft)
        return np.sqrt(((found - ground) ** 2).mean(axis=0))

    def film_errors_px(self, index, adjusted):
        """Difference of two cameras over the film, without distortion, px."""
        film = film_sample(np.random.default_rng(98), 1000)
        ground = on_terrain(self.cameras[index], film)
        return (adjusted.project(ground) - film) / PIXEL_MM


def film_sample(rng, count):
    return rng.uniform([-HALF_LENGTH_MM, -HALF_WIDTH_MM], [HALF_LENGTH_MM, HALF_WIDTH_MM], (count, 2))


def conjugates(cameras, rng, count):
    first = film_sample(rng, 2 * count)
    ground = on_terrain(cameras[0], first)
    second = cameras[1].project(ground)
    seen = (np.abs(second) <= [HALF_LENGTH_MM, HALF_WIDTH_MM]).all(axis=1)
    return first[seen][:count], second[seen][:count], ground[seen][:count]


def simulate_pair(
    rng,
    *,
    name="1112",
    gcps=1000,
    ties=2000,
    distortion_px=0.0,
    gross_share=0.0,
    noise=1.0,
    film_sigma_px=0.0,
    pixel_mm=PIXEL_MM,
    cameras=None,
):
    """Observations of a pair; every other block of 60 x 27 mm of film is held out as check points.

    `film_sigma_px` is what the observations' sigmas allow for film distortion; `pixel_mm` the pixel that matching noise
    is measured in; `cameras` take the place of those of the table.
    """
    cameras = pair(name) if cameras is None else cameras
    distortions = (FilmDistortion(rng, distortion_px), FilmDistortion(rng, distortion_px))
    control, checks, gross = [], [], []
    for camera, distortion in zip(cameras, distortions, strict=True):
        film = film_sample(rng, gcps)
        ground = on_terrain(camera, film) + noise * rng.normal(size=(gcps, 3)) * [GROUND_M, GROUND_M, HEIGHT_M]
        measured = film + distortion(film) + noise * rng.normal(0.0, MATCH_PX * pixel_mm, film.shape)
        wrong = rng.random(gcps) < gross_share
        measured[wrong] += rng.uniform(-150.0, 150.0, (wrong.sum(), 2)) * PIXEL_MM
        held_out = (np.floor(film[:, 0] / 60.0) + np.floor(film[:, 1] / 27.0)) % 2 == 0
        for part, chosen in ((control, ~held_out), (checks, held_out & ~wrong)):
            count = int(chosen.sum())
            part.append(
                Control(
                    film_mm=measured[chosen],
                    ground_m=ground[chosen],
                    sigma_mm=np.full(count, np.hypot(MATCH_PX, film_sigma_px) * pixel_mm),
                    sigma_ground_m=np.full(count, GROUND_M),
                    sigma_height_m=np.full(count, HEIGHT_M),
                )
            )
        gross.append(wrong[~held_out])
    first, second, _ = conjugates(cameras, rng, ties)
    first_mm, second_mm = (
        film + distortion(film) + noise * rng.normal(0.0, TIE_PX * pixel_mm, film.shape)
        for film, distortion in zip((first, second), distortions, strict=True)
    )
    sigma_mm = np.full(len(first), np.hypot(TIE_PX, film_sigma_px) * pixel_mm)
    return SimulatedPair(cameras, distortions, control, checks, gross, Ties(0, 1, first_mm, second_mm, sigma_mm))
