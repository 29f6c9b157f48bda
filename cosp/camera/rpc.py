"""Rational polynomial coefficients: a camera's ground-to-image function in the form that most programs read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.exits import Residual, film_lattice
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window, strips

# Powers of longitude, latitude and height in the order of RPC00B.
POWERS = np.array(
    [
        *([0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [2, 0, 0], [0, 2, 0], [0, 0, 2]),
        *([1, 1, 1], [3, 0, 0], [1, 2, 0], [1, 0, 2], [2, 1, 0], [0, 3, 0], [0, 1, 2], [2, 0, 1], [0, 2, 1], [0, 0, 3]),
    ]
)
LATTICE = (25, 9, 6)  # columns, rows, heights that a fit rests on
ROUNDS = 3  # of the linear fit, each weighted by the denominators of the one before
# Smaller ridges are more accurate, larger ones keep denominators from zeros, which ruin a strip of the image: the first
# is taken that leaves denominators well above zero.
RIDGES = (1e-6, 1e-5, 1e-4)
LEAST_DENOMINATOR = 0.5


@dataclass(frozen=True)
class Rpc:
    """Column and row as quotients of cubic polynomials in normalised longitude, latitude and height.

    Pixels are counted from the centre of the first.

    Parameters
    ----------
    ground_offset, ground_scale : three floats
        Of longitude and latitude in degrees and ellipsoidal height in metres.
    image_offset, image_scale : two floats
        Of columns and rows.
    numerators, denominators : two tuples of twenty floats
        Of columns and rows, in the order of RPC00B.

    References
    ----------
    STDI-0002, the compendium of extensions of NITF: RPC00B.
    """

    ground_offset: tuple[float, float, float]
    ground_scale: tuple[float, float, float]
    image_offset: tuple[float, float]
    image_scale: tuple[float, float]
    numerators: tuple[tuple[float, ...], tuple[float, ...]]
    denominators: tuple[tuple[float, ...], tuple[float, ...]]

    def pixels(self, lonlath: FloatArray) -> FloatArray:
        """Columns and rows (..., 2) of longitudes, latitudes (degrees) and ellipsoidal heights (..., 3)."""
        terms = _terms((_near(lonlath, self.ground_offset[0]) - self.ground_offset) / self.ground_scale)
        quotients = (terms @ np.transpose(self.numerators)) / (terms @ np.transpose(self.denominators))
        return np.asarray(quotients * self.image_scale + self.image_offset)

    def metadata(self) -> dict[str, str]:
        """Names and values as GDAL keeps them; the errors are not known."""
        values = {"ERR_BIAS": "-1", "ERR_RAND": "-1"}
        names = (("LONG", "LAT", "HEIGHT"), ("SAMP", "LINE"))
        for axes, offsets, scales in zip(
            names, (self.ground_offset, self.image_offset), (self.ground_scale, self.image_scale), strict=True
        ):
            for axis, offset, scale in zip(axes, offsets, scales, strict=True):
                values |= {f"{axis}_OFF": repr(offset), f"{axis}_SCALE": repr(scale)}
        for axis, numerator, denominator in zip(names[1], self.numerators, self.denominators, strict=True):
            values[f"{axis}_NUM_COEFF"] = " ".join(map(repr, numerator))
            values[f"{axis}_DEN_COEFF"] = " ".join(map(repr, denominator))
        return values

    def text(self) -> str:
        """The text of an `_RPC.TXT` file: one number a line."""
        lines = []
        for key, value in self.metadata().items():
            words = value.split()
            names = [key] if len(words) == 1 else [f"{key}_{i}" for i in range(1, len(words) + 1)]
            lines += [f"{name}: {word}" for name, word in zip(names, words, strict=True)]
        return "\n".join(lines) + "\n"


def fit_pieces(
    camera: PanoramicCamera, grid: PixelGrid, *, heights_m: tuple[float, float], pieces: int, largest_px: float
) -> list[tuple[Window, Rpc, Residual]]:
    """Coefficients for pieces of an image, one after the other along the film, with their windows and residuals.

    A whole film is more than cubic polynomials can follow, by pixels; a quarter they follow to some hundredths.

    Parameters
    ----------
    camera : PanoramicCamera
    grid : PixelGrid
        Image of the film, mm.
    heights_m : lowest and highest
        Ellipsoidal heights between which the fit holds.
    pieces : int
        Least number of pieces. More are made, up to four times as many, until none leaves more than `largest_px`.
    largest_px : float
    """
    rows, columns = grid.shape
    for count in range(pieces, 4 * pieces + 1):
        found = []
        for start, stop in strips(columns, count):
            part = grid.window(0, rows, start, stop)
            rpc = fit_rpc(camera, part, heights_m=heights_m)
            residual = Residual.of(residuals_px(rpc, camera, part, *film_lattice(part, heights_m)))
            found.append((Window(0, rows, start, stop), rpc, residual))
        if max(residual.largest_px for _, _, residual in found) <= largest_px:
            break
    return found


def fit_rpc(camera: PanoramicCamera, grid: PixelGrid, *, heights_m: tuple[float, float]) -> Rpc:
    """Coefficients that do on an image what a camera does, between two ellipsoidal heights."""
    film_mm, height_m = film_lattice(grid, heights_m, LATTICE)
    rows, columns = grid.pixels(film_mm)
    lonlath = camera.locate_geodetic(film_mm, height_m)
    lonlath = _near(lonlath, float(lonlath[0, 0]))
    pixels = np.stack([columns, rows], axis=-1)
    (ground_offset, ground_scale), (image_offset, image_scale) = (_normalisation(v) for v in (lonlath, pixels))
    terms = _terms((lonlath - ground_offset) / ground_scale)
    quotients = [_fit_quotient(terms, values) for values in np.transpose((pixels - image_offset) / image_scale)]
    return Rpc(
        ground_offset=(ground_offset[0], ground_offset[1], ground_offset[2]),
        ground_scale=(ground_scale[0], ground_scale[1], ground_scale[2]),
        image_offset=(image_offset[0], image_offset[1]),
        image_scale=(image_scale[0], image_scale[1]),
        numerators=(quotients[0][0], quotients[1][0]),
        denominators=(quotients[0][1], quotients[1][1]),
    )


def residuals_px(
    rpc: Rpc, camera: PanoramicCamera, grid: PixelGrid, film_mm: FloatArray, height_m: FloatArray
) -> FloatArray:
    """Columns and rows that the coefficients give, minus those of the camera, (N, 2).

    Parameters
    ----------
    rpc, camera : Rpc, PanoramicCamera
    grid : PixelGrid
        Image of a part of the film, mm.
    film_mm, height_m : (N, 2) array, mm; (N,) array, m
        Film points, and the ellipsoidal heights at which they are located.
    """
    rows, columns = grid.pixels(film_mm)
    lonlath = camera.locate_geodetic(film_mm, height_m)
    return np.asarray(rpc.pixels(lonlath) - np.stack([columns, rows], axis=-1))


def _fit_quotient(terms: FloatArray, values: FloatArray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Numerator and denominator, whose first coefficient is one, of a function given at points."""
    count, numerator = terms.shape
    system = np.hstack([terms, -values[:, None] * terms[:, 1:]])
    padded = np.append(np.zeros(numerator - 1), values)
    for ridge in RIDGES:
        shrink = ridge * np.sqrt(count) * np.eye(system.shape[1])[numerator:]
        denominators = np.ones(count)
        for _ in range(ROUNDS):
            weights = np.append(np.ones(numerator - 1), 1.0 / denominators)
            found = np.linalg.lstsq(np.vstack([shrink, system]) * weights[:, None], padded * weights)[0]
            denominators = 1.0 + terms[:, 1:] @ found[numerator:]
        if denominators.min() > LEAST_DENOMINATOR:
            break
    return tuple(found[:numerator].tolist()), (1.0, *found[numerator:].tolist())


def _terms(normalised: FloatArray) -> FloatArray:
    """The twenty products of powers at points (..., 3)."""
    powers = np.asarray(normalised)[..., None] ** np.arange(4)
    return np.asarray(powers[..., 0, POWERS[:, 0]] * powers[..., 1, POWERS[:, 1]] * powers[..., 2, POWERS[:, 2]])


def _near(lonlath: FloatArray, longitude_deg: float) -> FloatArray:
    """The same points with longitudes within half a turn of a given one."""
    near = np.array(lonlath, dtype=float)
    near[..., 0] = longitude_deg + (near[..., 0] - longitude_deg + 180.0) % 360.0 - 180.0
    return near


def _normalisation(values: FloatArray) -> tuple[list[float], list[float]]:
    """Offsets and scales that bring columns of values between -1 and 1."""
    low, high = values.min(axis=0), values.max(axis=0)
    return ((low + high) / 2.0).tolist(), ((high - low) / 2.0).tolist()
