"""Small films with known truth: texture, format, stripes, bending, parts cut out with known motions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cosp.arrays import ByteArray, FloatArray
from cosp.geometry.transforms import Rigid

LENGTH_MM, WIDTH_MM, FILM_MM = 744.8, 55.4, 70.0
STRIPE_MM = 2.1  # beyond the edge of the picture


@dataclass(frozen=True)
class Film:
    """A film scan in one piece and where its things are.

    Parameters
    ----------
    image : (rows, columns) uint8 array
    centre : (x, y), px
        Of the format.
    pixel_mm : float
    """

    image: ByteArray
    centre: tuple[float, float]
    pixel_mm: float
    tilt_rad: float

    def bend_mm(self, x_mm: FloatArray, side: int) -> FloatArray:
        """Displacement upwards of the stripe at the top (side 1) or at the bottom (-1)."""
        return bend_mm(x_mm, side)


def bend_mm(x_mm: FloatArray, side: int) -> FloatArray:
    """Smooth displacement across the film of a tenth of a millimetre."""
    u = np.asarray(x_mm) / (LENGTH_MM / 2)
    return 0.10 * np.cos(2.1 * u + 0.3 * side) + 0.04 * np.sin(5.0 * u - side)


def texture(shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Ground-like texture between 0 and 1: noise of several sizes."""
    total = np.zeros(shape, np.float32)
    for size, weight in ((1.2, 0.5), (4.0, 0.8), (16.0, 1.0), (60.0, 1.2)):
        grid = (int(shape[0] / size) + 4, int(shape[1] / size) + 4)
        noise = rng.normal(size=grid).astype(np.float32)
        matrix = np.array([[1 / size, 0, 1.0], [0, 1 / size, 1.0]])
        total += weight * cv2.remap(
            noise,
            *np.meshgrid(
                (np.arange(shape[1]) * matrix[0, 0] + 1).astype(np.float32),
                (np.arange(shape[0]) * matrix[1, 1] + 1).astype(np.float32),
            ),
            cv2.INTER_CUBIC,
        )
    return 1.0 / (1.0 + np.exp(-1.1 * total))


def make_film(
    rng: np.random.Generator,
    *,
    pixel_mm: float = 0.112,
    tilt_deg: float = 0.2,
    stripes: bool = True,
    bent: bool = True,
    length_mm: float = LENGTH_MM,
    leader_mm: float = 18.0,
) -> Film:
    """A whole film scan with picture, dark border, stripes, rail holes, titling and a white strip beyond the film."""
    columns = round((length_mm + 2 * leader_mm) / pixel_mm)
    rows = round((FILM_MM + 8.0) / pixel_mm)
    centre = ((columns - 1) / 2 + 3.3, (rows - 1) / 2 - 2.2)
    tilt = np.radians(tilt_deg)
    c, r = np.meshgrid(np.arange(columns, dtype=np.float32), np.arange(rows, dtype=np.float32))
    dx, dy = c - centre[0], r - centre[1]
    x = (np.cos(tilt) * dx + np.sin(tilt) * dy) * pixel_mm
    y = -(-np.sin(tilt) * dx + np.cos(tilt) * dy) * pixel_mm
    if bent:
        half = WIDTH_MM / 2 + STRIPE_MM
        top, bottom = bend_mm(x, 1), bend_mm(x, -1)
        y = y - (bottom + (top - bottom) * (y + half) / (2 * half))
    ground = 40 + 200 * texture((rows, columns), rng)

    def inside(distance_mm: FloatArray) -> FloatArray:
        return np.clip(distance_mm / pixel_mm + 0.5, 0, 1)

    picture = inside(length_mm / 2 - np.abs(x)) * inside(WIDTH_MM / 2 - np.abs(y))
    image = 22 + picture * (ground - 22)
    if stripes:
        width = 0.10
        for side in (1, -1):
            profile = np.exp(-0.5 * ((y - side * (WIDTH_MM / 2 + STRIPE_MM)) / max(width, 0.6 * pixel_mm)) ** 2)
            image += 90 * profile * inside(length_mm / 2 - np.abs(x))
            hole = np.hypot((x + 5.0) % 10.0 - 5.0, y - side * (WIDTH_MM / 2 + 4.6))
            image += 120 * inside(0.5 - hole) * inside(length_mm / 2 - np.abs(x))
    image = np.where(np.abs(y) > FILM_MM / 2, 240.0, image)
    title = (np.abs(x + 60) < 18) & (np.abs(y - WIDTH_MM / 2 - 6.3) < 0.5) & (np.sin(6 * x) > 0.2)
    image = np.where(title, 230.0, image) + rng.normal(scale=2.0, size=image.shape)
    return Film(np.clip(np.rint(image), 1, 255).astype(np.uint8), centre, pixel_mm, float(tilt))


def cut(
    film: Film,
    rng: np.random.Generator,
    *,
    overlaps_mm: tuple[float, ...] = (40.0, 15.0, 70.0),
    rotations_deg: tuple[float, ...] = (0.1, -0.4, 0.3, 0.5),
    gains: tuple[float, ...] = (1.0, 0.9, 1.1, 0.95),
) -> tuple[list[ByteArray], list[Rigid]]:
    """Overlapping parts of a film and the motion of each into it."""
    pieces = len(rotations_deg)
    rows, columns = film.image.shape
    step = columns / pieces
    parts, motions = [], []
    for k in range(pieces):
        before = overlaps_mm[k - 1] / 2 / film.pixel_mm if k else 0.0
        after = overlaps_mm[k] / 2 / film.pixel_mm if k < pieces - 1 else 0.0
        x0, x1 = k * step - before, (k + 1) * step + after
        motion = Rigid(float(np.radians(rotations_deg[k])), (float(x0 + rng.uniform(-1, 1)), float(rng.uniform(-3, 3))))
        shape = (rows, round(x1 - x0))
        inverse = motion
        c, s = np.cos(inverse.rotation_rad), np.sin(inverse.rotation_rad)
        matrix = np.array([[c, -s, inverse.shift[0]], [s, c, inverse.shift[1]]])
        seen = cv2.warpAffine(
            film.image.astype(np.float32),
            matrix,
            (shape[1], shape[0]),
            flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
            borderValue=245.0,
        )
        noisy = gains[k] * seen + 3.0 * k + rng.normal(scale=1.0, size=shape)
        parts.append(np.clip(np.rint(noisy), 1, 255).astype(np.uint8))
        motions.append(motion)
    return parts, motions
