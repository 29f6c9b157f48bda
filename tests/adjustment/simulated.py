"""A pair with known truth: the paper's cameras, hilly ground, smooth film distortion, noise, gross errors."""

from dataclasses import dataclass, replace

import numpy as np

from cosp.adjustment.observations import Control, Ties
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
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


class SteppedFilm:
    """Film whose scanner set it down anew every 20 mm, each time some pixels off, besides its smooth distortion."""

    every_mm = 20.0

    def __init__(self, rng, smooth, step_px):
        self.smooth = smooth
        self.offset_mm = rng.normal(0.0, step_px * PIXEL_MM / np.sqrt(2.0), (64, 2))

    def __call__(self, film_mm):
        block = np.clip((film_mm[..., 0] / self.every_mm + 32).astype(int), 0, 63)
        return self.smooth(film_mm) + self.offset_mm[block]


# Where parts of the two films were joined; on the ground some of the places nearly agree.
JOINTS_MM = ((-183.0, 4.0, 190.0), (-178.0, -9.0, 186.0))


class JoinedFilm:
    """Film in four parts that were laid down off their places, besides its smooth distortion."""

    def __init__(self, rng, smooth, joints_mm, step_px):
        self.smooth = smooth
        self.joints_mm = np.asarray(joints_mm)
        # Of both edges of the film: each part is shifted and turned a little against the one before it.
        self.steps_mm = rng.normal(0.0, step_px * PIXEL_MM, (len(joints_mm), 2, 2))

    def __call__(self, film_mm):
        offsets = np.concatenate([np.zeros((1, 2, 2)), np.cumsum(self.steps_mm, axis=0)])
        offsets = offsets[np.searchsorted(self.joints_mm, film_mm[..., 0])]
        share = (film_mm[..., 1:] + HALF_WIDTH_MM) / (2.0 * HALF_WIDTH_MM)
        return self.smooth(film_mm) + (1.0 - share) * offsets[..., 0, :] + share * offsets[..., 1, :]


class BentFilm:
    """Film that was not straightened: bent across by three waves over its length, besides its smooth distortion."""

    def __init__(self, rng, smooth, rms_mm):
        self.smooth = smooth
        size = rng.normal(size=3) / [1.0, 1.5, 2.0]
        self.amplitude_mm = rms_mm * size / np.sqrt(np.mean(size**2) * 1.5)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 3)

    def __call__(self, film_mm):
        waves = np.sin(film_mm[..., :1] * np.pi * np.arange(1, 4) / HALF_LENGTH_MM + self.phase)
        return self.smooth(film_mm) + np.stack([np.zeros(waves.shape[:-1]), waves @ self.amplitude_mm], axis=-1)


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
    step_px=0.0,
    joint_px=0.0,
    bending_mm=0.0,
):
    """Observations of a pair; every other block of 60 x 27 mm of film is held out as check points.

    `film_sigma_px` is what the observations' sigmas allow for film distortion; `pixel_mm` the pixel that matching noise
    is measured in; `cameras` take the place of those of the table.
    """
    cameras = pair(name) if cameras is None else cameras
    distortions = (FilmDistortion(rng, distortion_px), FilmDistortion(rng, distortion_px))
    if step_px:
        distortions = tuple(SteppedFilm(rng, smooth, step_px) for smooth in distortions)
    if bending_mm:
        distortions = tuple(BentFilm(rng, smooth, bending_mm) for smooth in distortions)
    if joint_px:
        distortions = tuple(
            JoinedFilm(rng, smooth, joints, joint_px) for smooth, joints in zip(distortions, JOINTS_MM, strict=True)
        )
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


OVERLAP = 0.08  # of successive frames of one camera, share of their width
# How unlike successive frames are: velocity, attitude, its rates.
UNLIKE = np.concatenate([np.zeros(3), [5.0] * 3, np.radians([0.1] * 3 + [0.01] * 3), [1e-4]])


@dataclass(frozen=True)
class SimulatedBlock:
    """Successive pairs of one pass: fore and aft of the first pair, of the second, and so on."""

    cameras: list[PanoramicCamera]
    distortions: list[FilmDistortion]
    control: list[Control]
    ties: list[Ties]

    @property
    def film_groups(self):
        return [image % 2 for image in range(len(self.cameras))]

    def start(self, rng, off_m=1000.0):
        """Start cameras, each off in its place on the ground."""
        found = []
        for camera in self.cameras:
            off = np.concatenate([rng.normal(0.0, off_m, 2), np.zeros(11)])
            found.append(camera.with_parameters(camera.parameters() + off))
        return found

    def without_control(self, images):
        """The same, of which some images have no control."""
        nothing = Control(np.empty((0, 2)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0))
        return replace(self, control=[nothing if i in images else points for i, points in enumerate(self.control)])

    def errors_m(self, adjusted, pair, count=2000):
        """East, north, up (N, 3) of noise-free points of a pair intersected with adjusted cameras, and first points."""
        fore, aft = 2 * pair, 2 * pair + 1
        first, second, ground = conjugates((self.cameras[fore], self.cameras[aft]), np.random.default_rng(99), count)
        measured = [film + self.distortions[i](film) for i, film in ((fore, first), (aft, second))]
        found, _ = meet(*(adjusted[i].rays(film) for i, film in zip((fore, aft), measured, strict=True)))
        return found - ground, measured[0]


def simulate_block(rng, *, pairs=3, gcps=300, ties=1500, neighbour_ties=200, distortion_px=1.5):
    """Observations of successive pairs, whose neighbouring frames overlap by a few per cent."""
    first = pair("1112")
    edges = first[0].locate(np.array([[0.0, -27.7], [0.0, 27.7]]), 1500.0)
    step = (1.0 - OVERLAP) * (edges[0] - edges[1])
    cameras, origin = [], first[0].origin
    for n in range(pairs):
        longitude, latitude, _ = origin.geodetic_from_local(n * step)
        for camera, name in zip(first, "FA", strict=True):
            moved = replace(
                camera, origin=LocalFrame(float(longitude), float(latitude)), scene=f"DS1112-D{name}{n:03d}"
            )
            moved = moved.moved_to(origin)
            cameras.append(moved.with_parameters(moved.parameters() + UNLIKE * rng.normal(size=13)))
    distortions = [FilmDistortion(rng, distortion_px) for _ in cameras]

    def measured(image, film):
        return film + distortions[image](film)

    def tied(one, other, count, neighbours):
        films = conjugates((cameras[one], cameras[other]), rng, 10 * count if neighbours else count)[:2]
        noisy = [
            measured(image, film[:count]) + rng.normal(0.0, TIE_PX * PIXEL_MM, film[:count].shape)
            for image, film in zip((one, other), films, strict=True)
        ]
        return Ties(one, other, *noisy, np.full(len(noisy[0]), TIE_PX * PIXEL_MM), neighbours)

    control = []
    for image, camera in enumerate(cameras):
        film = film_sample(rng, gcps)
        ground = on_terrain(camera, film)
        given = ground + rng.normal(0.0, [GROUND_M, GROUND_M, HEIGHT_M], ground.shape)
        noisy = measured(image, film) + rng.normal(0.0, MATCH_PX * PIXEL_MM, film.shape)
        sigmas = (np.full(gcps, sigma) for sigma in (MATCH_PX * PIXEL_MM, GROUND_M, HEIGHT_M))
        control.append(Control(noisy, given, *sigmas))
    sets = [tied(2 * n, 2 * n + 1, ties, False) for n in range(pairs)]
    sets += [tied(2 * n + side, 2 * n + 2 + side, neighbour_ties, True) for n in range(pairs - 1) for side in (0, 1)]
    return SimulatedBlock(cameras, distortions, control, sets)
