"""What an adjustment is told: control and tie points with their weights, priors of the cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.derivatives import film_derivatives
from cosp.camera.panoramic import PanoramicCamera


@dataclass(frozen=True)
class Control:
    """Ground points seen in one image.

    Parameters
    ----------
    film_mm : (N, 2) array, mm
    ground_m : (N, 3) array, m
        In the local frame of the block.
    sigma_mm : (N,) array, mm
        Standard deviation of the film point, per axis.
    sigma_ground_m, sigma_height_m : (N,) arrays, m
        Standard deviations of the ground point, per horizontal axis and in height.
    covariance_mm2 : (N, 2, 2) array, mm^2
        What else the film point is wrong by, for ground points that are known better in some directions than in others;
        nothing when left out.
    """

    film_mm: FloatArray
    ground_m: FloatArray
    sigma_mm: FloatArray
    sigma_ground_m: FloatArray
    sigma_height_m: FloatArray
    covariance_mm2: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not self.covariance_mm2.size:
            object.__setattr__(self, "covariance_mm2", np.zeros((len(self.film_mm), 2, 2)))

    def __len__(self) -> int:
        return len(self.film_mm)


@dataclass(frozen=True)
class Ties:
    """Conjugate points of two images of a block; their ground points are unknown.

    Parameters
    ----------
    first, second : int
        Which images of the block.
    first_mm, second_mm : (N, 2) arrays, mm
    sigma_mm : (N,) array, mm
        Standard deviation of each film point, per axis.
    neighbours : bool
        The images are neighbouring frames of one camera. Their rays meet at a few degrees: such points tie the frames
        to each other where the reference gives the height, and have none of their own.
    """

    first: int
    second: int
    first_mm: FloatArray
    second_mm: FloatArray
    sigma_mm: FloatArray
    neighbours: bool = False

    def __len__(self) -> int:
        return len(self.first_mm)


@dataclass(frozen=True)
class HeightReference:
    """Heights of the ground that tie points may be held to.

    Parameters
    ----------
    heights_at : function
        Ellipsoidal heights (N,) of longitudes and latitudes (N, 2) in degrees; NaN where there are none and where the
        ground may have changed.
    sigma_m, sigma_horizontal_m : float
        Standard deviations of its heights and, per axis, of its position.
    largest_slope_deg : float
        Steeper ground is left out.
    """

    heights_at: Callable[[FloatArray], FloatArray]
    sigma_m: float
    sigma_horizontal_m: float
    largest_slope_deg: float


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is believed of a camera before any point is measured; the start camera is the mean.

    They keep parameters that a film hardly tells apart from running away and are weak enough to leave the others alone.

    Parameters
    ----------
    horizontal_m, height_m : float
        Position at mid-scan.
    velocity_m : three floats
        Change of position over the scan: along the flight, across it, up.
    angles_deg : three floats
        Omega, phi, kappa at mid-scan.
    rates_deg : three floats
        Their change over the scan.
    imc_factor : float

    References
    ----------
    docs/conventions.md, "Priors".
    """

    horizontal_m: float
    height_m: float
    velocity_m: tuple[float, float, float]
    angles_deg: tuple[float, float, float]
    rates_deg: tuple[float, float, float]
    imc_factor: float

    def information(self, camera: PanoramicCamera) -> FloatArray:
        """Inverse covariance of the 13 parameters, (13, 13), with the velocity turned into the camera's heading."""
        kappa = np.radians(camera.angles_deg[2])
        # Rows: along the flight (-y of the film), across it, up.
        heading = np.array([[np.sin(kappa), -np.cos(kappa), 0.0], [np.cos(kappa), np.sin(kappa), 0.0], [0.0, 0.0, 1.0]])
        information = np.zeros((13, 13))
        information[3:6, 3:6] = heading.T @ np.diag(1.0 / np.square(self.velocity_m)) @ heading
        sigma = [
            *(self.horizontal_m, self.horizontal_m, self.height_m),
            *(np.inf, np.inf, np.inf),
            *np.radians(self.angles_deg),
            *np.radians(self.rates_deg),
            self.imc_factor,
        ]
        return np.asarray(information + np.diag(1.0 / np.square(sigma)))


PLAIN_PRIORS = Priors(
    horizontal_m=100_000.0,
    height_m=20_000.0,
    velocity_m=(1000.0, 1000.0, 1000.0),
    angles_deg=(3.0, 3.0, 8.0),
    rates_deg=(0.5, 0.5, 0.3),
    imc_factor=0.02,
)
FIELD_PRIORS = Priors(
    horizontal_m=100_000.0,
    height_m=5_000.0,
    velocity_m=(80.0, 50.0, 30.0),
    angles_deg=(3.0, 3.0, 8.0),
    rates_deg=(0.1, 0.5, 0.1),
    imc_factor=0.002,
)


# How little the motion of a spacecraft changes from one frame to the next, a few seconds later: height (m), attitude
# (degrees), change of position over the scan (m), change of angles over the scan (degrees), image motion factor.
SUCCESSIVE_HEIGHT_M = 1000.0
SUCCESSIVE_ATTITUDE_DEG = 0.5
SUCCESSIVE_VELOCITY_M = 20.0
SUCCESSIVE_RATE_DEG = 0.03
SUCCESSIVE_IMC = 0.0005


def orbit_coupling(scenes: Sequence[str], film_groups: Sequence[int]) -> FloatArray:
    """Information that ties the motions of successive frames of one camera to each other, (13 n, 13 n).

    The horizontal position at mid-scan stays free: when a frame was taken is not known well enough. Height and attitude
    are held so loosely that only frames without control feel it.

    Parameters
    ----------
    scenes : sequence of str
        Archive ids, whose order is that of the frames.
    film_groups : sequence of int
        Which images were taken by the same camera.
    """
    count = len(scenes)
    information = np.zeros((13 * count, 13 * count))
    sigma = np.concatenate(
        [
            [SUCCESSIVE_HEIGHT_M],
            [SUCCESSIVE_VELOCITY_M] * 3,
            np.radians([SUCCESSIVE_ATTITUDE_DEG] * 3),
            np.radians([SUCCESSIVE_RATE_DEG] * 3),
            [SUCCESSIVE_IMC],
        ]
    )
    moving = np.arange(2, 13)
    for group in sorted(set(film_groups)):
        frames = sorted((image for image in range(count) if film_groups[image] == group), key=lambda i: scenes[i])
        for first, second in zip(frames, frames[1:], strict=False):
            for a, b, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
                information[13 * a + moving, 13 * b + moving] += sign / sigma**2
    return information


def place_information(camera: PanoramicCamera, sigma_m: float) -> FloatArray:
    """Information (13, 13) of knowing where on the ground the middle of a frame lies, per horizontal axis, metres."""
    middle = np.zeros((1, 2))
    ground = camera.locate(middle, 0.0)
    by_camera, by_ground = (of[0] for of in film_derivatives(camera, ground, middle))
    covariance = sigma_m**2 * by_ground[:, :2] @ by_ground[:, :2].T
    return np.asarray(by_camera.T @ np.linalg.solve(covariance, by_camera))
