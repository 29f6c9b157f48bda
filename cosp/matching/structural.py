"""Structural template matching: dense channels of gradient orientation, correlated by FFT.

Gradient orientation is taken modulo 180 degrees, so that neither contrast reversal nor another sun changes a ridge or a
river bank much. On images brought to one map geometry only a translation remains, which is all that templates look for.

References
----------
[Ye2019] channel features of orientated gradients (CFOG).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from cosp.arrays import BoolArray, Float32Array, FloatArray, IntArray
from cosp.imaging.correlation import ncc_surfaces, subpixel_peaks
from cosp.matching.correspondences import Correspondences

# Below this part of the image's typical gradient a pixel counts as flat: its orientation is noise.
_FLAT_SHARE = 0.5
# Search margin of the backward match: it only has to confirm, not to find.
_BACKWARD_PX = 5
# Templates correlated at once by one thread.
_BATCH = 48
# A Cramer-Rao bound says how a lower score spreads a match; between these limits, in pixels of the matched images.
_SIGMA_LIMITS_PX = (0.15, 1.0)
_SIGMA_SCALE_PX = 0.25


def orientation_channels(image: FloatArray, *, bins: int, sigma_px: float) -> Float32Array:
    """Channels of gradient orientation modulo 180 degrees, (bins, rows, columns), unit length at textured pixels.

    Each gradient is shared by its two nearest bins, the channels are smoothed in x, y and orientation, and the vector
    of each pixel is divided by its length plus a share of the image's typical length, so that flat ground fades out.

    Parameters
    ----------
    image : (rows, columns) array
        NaN where there is nothing; the channels are 0 there and within reach of it.
    bins : int
    sigma_px : float
        Standard deviation of the smoothing in x and y; half of it is used before the gradient is taken.
    """
    valid = np.isfinite(image)
    if not valid.any():
        return np.zeros((bins, *image.shape), np.float32)
    level = float(np.median(image[valid]))
    filled = np.where(valid, image, level).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), max(sigma_px / 2, 0.5))
    gradient_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3)
    gradient_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    reach = 2 * int(np.ceil(sigma_px)) + 1
    inside = valid if valid.all() else cv2.erode(valid.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    length = np.where(inside, np.hypot(gradient_x, gradient_y), 0.0).astype(np.float32)

    place = np.mod(np.arctan2(gradient_y, gradient_x), np.pi) * np.float32(bins / np.pi)
    lower = np.floor(place)
    share = length * (place - lower)
    index = lower.astype(np.intp)[None] % bins
    raw = np.zeros((bins, *image.shape), np.float32)
    np.put_along_axis(raw, index, (length - share)[None], axis=0)
    np.put_along_axis(raw, (index + 1) % bins, share[None], axis=0)
    for channel in raw:
        cv2.GaussianBlur(channel, (0, 0), sigma_px, dst=channel)
    channels = 0.5 * raw
    raw *= 0.25
    for step in (1, -1):
        for number in range(bins):
            channels[number] += raw[(number + step) % bins]
    norm = np.sqrt(np.einsum("kij,kij->ij", channels, channels))
    typical = float(np.median(norm[inside])) if inside.any() else 0.0
    channels /= norm + _FLAT_SHARE * typical + 1e-6
    channels *= inside
    return channels.astype(np.float32, copy=False)


@dataclass(frozen=True)
class StructuralMatcher:
    """Templates of orientation channels from one image, found in another one of the same geometry.

    Parameters
    ----------
    template_px : int
        Side of a template; made odd.
    search_px : int
        Largest shift looked for, in each direction.
    bins : int
        Orientation channels.
    sigma_px : float
        Smoothing of the channels.
    min_score : float
        Smallest normalised correlation of a match.
    max_ratio : float
        Largest ratio of the second-highest peak to the highest.
    max_return_px : float
        Largest distance by which the match back may miss its start.
    min_valid : float
        Smallest share of a template, and of what it is compared with, that must hold data.
    """

    template_px: int
    search_px: int
    bins: int
    sigma_px: float
    min_score: float
    max_ratio: float
    max_return_px: float
    min_valid: float

    def match(self, moving: FloatArray, fixed: FloatArray, points_rc: FloatArray, *, threads: int) -> Correspondences:
        """Where the surroundings of points of one image lie in the other.

        Parameters
        ----------
        moving, fixed : (rows, columns) arrays of equal shape
            NaN where there is nothing.
        points_rc : (N, 2) array
            Places in `moving`, rounded to whole pixels; those too near the border are left out.
        threads : int
        """
        channels = self._channels(moving, fixed)
        points = np.unique(np.round(np.asarray(points_rc, float).reshape(-1, 2)).astype(np.intp), axis=0)
        found, _ = self._match_about(channels, moving, fixed, points, points, self.search_px, self.max_ratio, threads)
        return found

    def refine(
        self, moving: FloatArray, fixed: FloatArray, matches: Correspondences, *, reach_px: int, threads: int
    ) -> Correspondences:
        """Matches of another matcher brought to a fraction of a pixel, without those that structure does not confirm.

        Parameters
        ----------
        moving, fixed : (rows, columns) arrays of equal shape
            NaN where there is nothing.
        matches : Correspondences
            Their own scores are kept: they tell right from wrong better than a correlation that only has to place.
        reach_px : int
            How far a match may be off.
        threads : int
        """
        start = np.round(matches.moving_rc).astype(np.intp)
        expected = start + np.round(matches.fixed_rc - matches.moving_rc).astype(np.intp)
        channels = self._channels(moving, fixed)
        # Which of a few places within reach is right has been decided already: no ratio test.
        found, kept = self._match_about(channels, moving, fixed, start, expected, reach_px, np.inf, threads)
        return Correspondences(found.moving_rc, found.fixed_rc, matches.score[kept], found.sigma_px)

    def _channels(self, moving: FloatArray, fixed: FloatArray) -> list[Float32Array]:
        return [orientation_channels(image, bins=self.bins, sigma_px=self.sigma_px) for image in (moving, fixed)]

    def _match_about(
        self,
        channels: list[Float32Array],
        moving: FloatArray,
        fixed: FloatArray,
        points: IntArray,
        expected: IntArray,
        margin: int,
        max_ratio: float,
        threads: int,
    ) -> tuple[Correspondences, IntArray]:
        """Matches of points of one image near expected places of the other, and which of the points they are."""
        half = self.template_px // 2
        moving_share, fixed_share = (_box_share(np.isfinite(image), half) for image in (moving, fixed))
        usable = _is_inside(points, moving.shape, half) & _is_inside(expected, fixed.shape, half + margin)
        usable[usable] = moving_share[points[usable, 0], points[usable, 1]] >= self.min_valid
        chosen = np.flatnonzero(usable)

        def work(start: int) -> tuple[Correspondences, IntArray]:
            batch = chosen[start : start + _BATCH]
            found, good = self._match_batch(channels, fixed_share, points[batch], expected[batch], margin, max_ratio)
            return found, batch[good]

        starts = range(0, len(chosen), _BATCH)
        if threads > 1 and len(chosen) > _BATCH:
            with ThreadPoolExecutor(threads) as pool:
                parts = list(pool.map(work, starts))
        else:
            parts = [work(start) for start in starts]
        kept = np.concatenate([np.empty(0, np.intp), *(kept for _, kept in parts)])
        return Correspondences.joined([found for found, _ in parts]), kept

    def _match_batch(
        self,
        channels: list[Float32Array],
        fixed_share: Float32Array,
        centres: IntArray,
        expected: IntArray,
        margin: int,
        max_ratio: float,
    ) -> tuple[Correspondences, IntArray]:
        """Matches of a few templates, forward and backward, and which of them they are."""
        half = self.template_px // 2
        moving, fixed = channels
        forward, score, ratio = _find(moving, fixed, centres, expected, half, margin)
        good = np.isfinite(forward).all(1) & (score >= self.min_score) & (ratio <= max_ratio)
        whole = np.round(np.where(good[:, None], forward, 0.0)).astype(np.intp)
        target = expected + whole
        good &= fixed_share[target[:, 0], target[:, 1]] >= self.min_valid
        good[good] = _is_inside(target[good], fixed.shape[1:], half + _BACKWARD_PX)
        good[good] &= _is_inside(centres[good], moving.shape[1:], half + _BACKWARD_PX)
        kept = np.flatnonzero(good)
        centres, expected, target, whole = centres[kept], expected[kept], target[kept], whole[kept]
        forward, score = forward[kept], score[kept]
        backward, back_score, _ = _find(fixed, moving, target, centres, half, _BACKWARD_PX)
        miss = np.linalg.norm(backward + (forward - whole), axis=1)
        with np.errstate(invalid="ignore"):
            good = miss <= self.max_return_px
        shift = (forward + whole - backward) / 2
        score = np.minimum(score, back_score)[good]
        found = Correspondences(
            moving_rc=centres[good].astype(float),
            fixed_rc=(expected + shift)[good],
            score=score,
            sigma_px=_sigma_px(score),
        )
        return found, kept[good]


def _find(
    source: Float32Array,
    target: Float32Array,
    source_centres: IntArray,
    target_centres: IntArray,
    half: int,
    margin: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shift, score and ratio of templates about places of `source`, looked for about places of `target`."""
    templates = _crops(source, source_centres, half)
    searches = _crops(target, target_centres, half + margin)
    return subpixel_peaks(ncc_surfaces(templates, searches))


def _crops(channels: Float32Array, centres: IntArray, half: int) -> Float32Array:
    crops = np.empty((len(centres), len(channels), 2 * half + 1, 2 * half + 1), np.float32)
    for index, (row, column) in enumerate(centres):
        crops[index] = channels[:, row - half : row + half + 1, column - half : column + half + 1]
    return crops


def _is_inside(centres: IntArray, shape: tuple[int, ...], margin: int) -> BoolArray:
    limit = np.array(shape) - margin
    return np.asarray(((centres >= margin) & (centres < limit)).all(axis=1))


def _box_share(valid: BoolArray, half: int) -> Float32Array:
    """Share of valid pixels in the box about each pixel."""
    side = 2 * half + 1
    return np.asarray(cv2.blur(valid.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT))


def _sigma_px(score: FloatArray) -> FloatArray:
    """Standard deviation of a match, from its correlation as a signal-to-noise ratio."""
    safe = np.clip(score, 0.05, 0.999)
    return np.clip(_SIGMA_SCALE_PX * np.sqrt(1 / safe**2 - 1), *_SIGMA_LIMITS_PX)
