"""Rigid motion of each seam between digitised parts.

A part is a (rows, columns) uint8 array; parts overlap along the film (columns). Places in a part and in the joined film
are points (x, y) = (column, row) in pixels, pixel centres on integers.
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from cosp.errors import InputError, StitchingError
from cosp.geometry.robust import tukey_weights
from cosp.geometry.statistics import nmad
from cosp.geometry.transforms import Rigid, estimate_rigid, ransac
from cosp.imaging.correlation import ncc_surfaces, subpixel_peaks
from cosp.imaging.resampling import block_mean
from cosp.imaging.windows import Window

_LOG = logging.getLogger(__name__)

# Keypoints kept per part: enough for an overlap that is a twentieth of it, few enough for a full comparison.
_KEYPOINTS = 8000
# Turn of one part against the next beyond the half circle: twice the half degree that a scanner operator leaves.
_ROTATION_LIMIT_DEG = 1.2
# Half width of a patch's search window while the motion is still coarse, and once it is nearly right.
_SEARCH_PX = (12, 5, 3)
_PATCHES = 600
_RIVAL_PATCH = 0.85  # height of the next peak over that of the first: more is chance
_PATCH_COLUMNS = 6  # of the patches that look for an overlap: the narrowest may hold the first only
# Farther than this from the common motion a patch is a blunder (dust, scratches, repeated pattern).
GATE_PX = 1.5
_RESIDUALS_KEPT = 250


@dataclass(frozen=True)
class Features:
    """Keypoints of one part, strongest first: places (N, 2) in px, angles (N,) in degrees, descriptors (N, 128)."""

    xy: FloatArray
    angle_deg: FloatArray
    descriptors: Float32Array

    def strongest(self, count: int | None) -> Features:
        """The first `count` of them; all for None."""
        return Features(self.xy[:count], self.angle_deg[:count], self.descriptors[:count])

    def where(self, chosen: BoolArray) -> Features:
        """Those of a mask (N,)."""
        return Features(self.xy[chosen], self.angle_deg[chosen], self.descriptors[chosen])


@dataclass(frozen=True)
class CoarseSeam:
    """What keypoints say about two parts: the motion from the right one into the left one, and how many agree.

    Parameters
    ----------
    motion : Rigid
        Right part to left part, px.
    inliers : int
    rivals : int
        Votes of the best other shift, for the margin.
    """

    motion: Rigid
    inliers: int
    rivals: int


@dataclass(frozen=True)
class Seam:
    """Joint of two neighbouring parts.

    Parameters
    ----------
    motion : Rigid
        Right part to left part, px.
    features : int
        Keypoints that agree on the coarse motion.
    patches, inliers : int
        Patches correlated, and those the motion is made from.
    rms_px, check_rms_px : float
        Residuals (per coordinate) of the inliers; of one half of them against a motion from the other half.
    overlap_px : int
        Width of the overlap.
    residuals : (N, 4) array
        x, y in the left part and the residual along x and y, px; of inliers, thinned.
    gain, offset : float
        Grey value of the left part = gain * grey value of the right part + offset.
    """

    motion: Rigid
    features: int
    patches: int
    inliers: int
    rms_px: float
    check_rms_px: float
    overlap_px: int
    residuals: FloatArray
    gain: float
    offset: float


def find_features(part: ByteArray, *, factor: int) -> Features:
    """SIFT keypoints of a part at reduced resolution, spread by local contrast equalisation.

    Parameters
    ----------
    part : (rows, columns) uint8 array
    factor : int
        Pixels of the part per pixel that the detector sees.
    """
    small = block_mean(np.ascontiguousarray(part), factor)
    tiles = (max(1, small.shape[1] // 64), max(1, small.shape[0] // 64))
    even = cv2.createCLAHE(clipLimit=4.0, tileGridSize=tiles).apply(small)
    detector = cv2.SIFT.create(nfeatures=_KEYPOINTS, contrastThreshold=0.02)
    keypoints, descriptors = detector.detectAndCompute(even, None)
    if descriptors is None or len(keypoints) == 0:
        return Features(np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.float32))
    order = np.argsort([-k.response for k in keypoints], kind="stable")
    xy = (np.array([k.pt for k in keypoints]) + 0.5) * factor - 0.5
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(xy[order], np.array([k.angle for k in keypoints])[order], rooted[order].astype(np.float32))


def turned_features(features: Features, shape: tuple[int, int]) -> Features:
    """Features of the same part turned by 180 degrees, `shape` being its (rows, columns)."""
    corner = np.array([shape[1] - 1.0, shape[0] - 1.0])
    return Features(corner - features.xy, (features.angle_deg + 180.0) % 360.0, features.descriptors)


def match_features(
    left: Features,
    right: Features,
    *,
    left_width_px: int,
    overlap_px: tuple[float, float],
    offset_px: float,
    gate_px: float,
    ratio: float,
    rng: np.random.Generator,
) -> CoarseSeam | None:
    """Motion from the right part into the left part that most keypoints vote for; None where none is plausible.

    Parameters
    ----------
    left, right : Features
    left_width_px : int
        Columns of the left part.
    overlap_px : (least, most)
        Plausible widths of the overlap.
    offset_px : float
        Largest plausible offset across the film.
    gate_px : float
        Largest distance of an inlier.
    ratio : float
        Largest ratio of the distances to the nearest and the second nearest descriptor.
    rng : numpy Generator
    """
    # Comparing all with all is dear: only what can lie in the overlap is looked at.
    reach = overlap_px[1] + gate_px
    left, right = left.where(left.xy[:, 0] > left_width_px - reach), right.where(right.xy[:, 0] < reach)
    source, target = _mutual_matches(left, right, ratio=ratio)
    return _agreed(
        source,
        target,
        left_width_px=left_width_px,
        overlap_px=overlap_px,
        offset_px=offset_px,
        gate_px=gate_px,
        rng=rng,
    )


def match_patches(
    left: ByteArray,
    right: ByteArray,
    *,
    factor: int,
    patch_px: int,
    overlap_px: tuple[float, float],
    offset_px: float,
    gate_px: float,
    rng: np.random.Generator,
) -> CoarseSeam | None:
    """Motion from the right part into the left part that most patches of the right one's beginning vote for.

    A patch uses all of its pixels: it finds its place in ground, such as sea, that has no keypoint. Dearer than
    `match_features`, whose parameters these are but for

    Parameters
    ----------
    factor : int
        Pixels of the parts per pixel that is looked at.
    patch_px : int
        Side of a patch.
    """
    width = int(min(overlap_px[1], left.shape[1]))
    first = left.shape[1] - width
    target_image = block_mean(np.ascontiguousarray(left[:, first:]), factor)
    source_image = block_mean(np.ascontiguousarray(right[:, :width]), factor)
    size, offset = patch_px // factor, int(np.ceil(offset_px / factor))
    padded = np.pad(target_image, ((offset, offset), (0, 0)), mode="edge")
    rows = np.arange(0, source_image.shape[0] - size, size)
    rows = rows[rows + size <= target_image.shape[0]]
    columns = size // 4 + size * np.arange(_PATCH_COLUMNS)
    columns = columns[columns + size <= source_image.shape[1]]
    source, target = [], []
    for row in rows:
        templates = np.stack([source_image[row : row + size, c : c + size] for c in columns]).astype(np.float32)
        band = padded[row : row + size + 2 * offset].astype(np.float32)
        surfaces = ncc_surfaces(templates, np.broadcast_to(band, (len(columns), *band.shape)))
        shift, _, rival = subpixel_peaks(surfaces)
        sure = (rival < _RIVAL_PATCH) & np.isfinite(shift).all(axis=1)
        source.append(np.column_stack([columns, np.full(len(columns), row)])[sure])
        centre = (np.array(surfaces.shape[:0:-1]) - 1) / 2
        target.append((shift[:, ::-1] + centre + (0.0, row - offset))[sure])
    if not source:
        return None
    # The middle of a patch, in pixels of the parts.
    middle = (np.array([size, size]) * factor - 1) / 2
    return _agreed(
        np.concatenate(source) * factor + middle,
        np.concatenate(target) * factor + middle + (first, 0.0),
        left_width_px=left.shape[1],
        overlap_px=overlap_px,
        offset_px=offset_px,
        gate_px=gate_px,
        rng=rng,
    )


def _agreed(
    source: FloatArray,
    target: FloatArray,
    *,
    left_width_px: int,
    overlap_px: tuple[float, float],
    offset_px: float,
    gate_px: float,
    rng: np.random.Generator,
) -> CoarseSeam | None:
    """The plausible motion from places (N, 2) of the right part to those of the left one that most agree on."""
    shift = target - source
    overlap = left_width_px - shift[:, 0]
    plausible = (overlap > overlap_px[0]) & (overlap < overlap_px[1]) & (np.abs(shift[:, 1]) < offset_px)
    source, target, shift = source[plausible], target[plausible], shift[plausible]
    if len(source) < 3:
        return None
    # Shifts refer to the corner of the right part, which lies in the overlap: a turn of a degree over an overlap of
    # 100 x 70 mm spreads the votes by two millimetres.
    reach = 10 * gate_px
    votes = (np.abs(shift[:, None] - shift[None]).max(axis=-1) < reach).sum(axis=1)
    first = int(votes.argmax())
    near = np.abs(shift - shift[first]).max(axis=-1) < 2 * reach
    rivals = int(votes[~near].max(initial=0))
    motion, inliers = ransac(estimate_rigid, source[near], target[near], minimum=2, gate=gate_px, trials=300, rng=rng)
    if motion is None or abs(np.degrees(motion.rotation_rad)) > _ROTATION_LIMIT_DEG:
        return None
    return CoarseSeam(motion, int(inliers.sum()), rivals)


def _mutual_matches(left: Features, right: Features, *, ratio: float) -> tuple[FloatArray, FloatArray]:
    """Places (N, 2) in the right and in the left part of descriptors that are each other's nearest."""
    if len(left.xy) < 3 or len(right.xy) < 3:
        return np.empty((0, 2)), np.empty((0, 2))
    similarity = right.descriptors @ left.descriptors.T
    index = np.arange(len(similarity))
    nearest, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    best = similarity[index, nearest]
    similarity[index, nearest] = -1.0
    second = similarity.max(axis=1)
    distance, rival = (np.sqrt(np.maximum(2.0 - 2.0 * s, 0.0)) for s in (best, second))
    angle = (right.angle_deg - left.angle_deg[nearest] + 180.0) % 360.0 - 180.0
    kept = (back[nearest] == index) & (distance < ratio * rival) & (np.abs(angle) < 15.0)
    return right.xy[kept], left.xy[nearest[kept]]


def refine_seam(
    left: ByteArray,
    right: ByteArray,
    coarse: CoarseSeam,
    *,
    min_score: float,
    min_inliers: int,
    names: tuple[str, str],
    rng: np.random.Generator,
    threads: int,
) -> Seam:
    """Seam to a hundredth of a pixel from patches correlated all over the overlap.

    The right part is resampled into the left one with the motion so far, patches are correlated at full resolution and
    the motion is estimated anew, three times, so that the last shifts are near zero and free of the peak's bias.

    Raises
    ------
    StitchingError
        Where fewer than `min_inliers` patches agree on one motion; names the seam.
    """
    motion = coarse.motion
    for search_px in _SEARCH_PX:
        size, points = _lattice(left.shape, right.shape, motion)
        found = correlate_patches(left, right, motion, points, size=(size, size), search_px=search_px, threads=threads)
        shift, score, ratio = found
        good = (score > min_score) & (ratio < 0.95) & np.isfinite(shift).all(axis=1)
        # Patch of the left part at p looks like the right part at motion^-1(p + shift).
        source = motion.inverse().apply(points[good] + shift[good][:, ::-1])
        target = points[good]
        estimate, inliers = ransac(
            estimate_rigid,
            source,
            target,
            minimum=2,
            gate=GATE_PX if search_px < _SEARCH_PX[0] else 2 * GATE_PX,
            trials=300,
            rng=rng,
        )
        if estimate is None or inliers.sum() < min_inliers:
            raise StitchingError(
                f"seam {names[0]} - {names[1]}: {int(inliers.sum())} of {len(points)} patches of the overlap agree on "
                f"one motion; {min_inliers} are needed"
            )
        source, target = source[inliers], target[inliers]
        motion = robust_rigid(source, target, estimate)
    residuals = target - motion.apply(source)
    # Patches overlap their neighbours; squares of a checkerboard share hardly any pixel.
    half = (target // (3 * size)).sum(axis=1) % 2 == 0
    check = residuals
    if 3 < half.sum() < len(half) - 3:
        check = target[~half] - estimate_rigid(source[half], target[half]).apply(source[~half])
    gain, offset = _grey_relation(left, right, motion, target)
    return Seam(
        motion=motion,
        features=coarse.inliers,
        patches=len(points),
        inliers=len(target),
        rms_px=float(np.sqrt(np.mean(residuals**2))),
        check_rms_px=float(np.sqrt(np.mean(check**2))),
        overlap_px=int(left.shape[1] - motion.shift[0]),
        residuals=thinned(target, residuals),
        gain=gain,
        offset=offset,
    )


def thinned(places: FloatArray, residuals: FloatArray) -> FloatArray:
    """Places and residuals (N, 4) of a few hundred points, for the record."""
    return np.column_stack([places, residuals])[:: max(1, -(-len(places) // _RESIDUALS_KEPT))]


def robust_rigid(source: FloatArray, target: FloatArray, start: Rigid) -> Rigid:
    """Rigid motion with Tukey's weights, from an estimate that is nearly right."""
    motion = start
    for _ in range(5):
        residuals = target - motion.apply(source)
        # A perfect copy has no noise; a thousandth of a pixel stands in for it.
        scale = max(nmad(residuals), 1e-3)
        weights = tukey_weights(np.linalg.norm(residuals, axis=1) / (np.sqrt(2.0) * scale))
        motion = estimate_rigid(source, target, np.maximum(weights, 1e-9))
    return motion


def _lattice(left_shape: tuple[int, ...], right_shape: tuple[int, ...], motion: Rigid) -> tuple[int, FloatArray]:
    """Patch size and patch centres (N, 2), whole pixels of the left part, spread evenly over the overlap."""
    x0, x1 = max(motion.shift[0], 0.0), min(left_shape[1], motion.shift[0] + right_shape[1])
    y0, y1 = max(motion.shift[1], 0.0), min(left_shape[0], motion.shift[1] + right_shape[0])
    size = int(np.clip((x1 - x0) / 4, 16, 64)) // 2 * 2
    # A turn of a degree moves the far edge of the overlap by a sixtieth of its height.
    edge = size / 2 + _SEARCH_PX[0] + 2 + 0.02 * (y1 - y0)
    if x1 - x0 < 2 * edge + size:
        edge = (x1 - x0 - size) / 2
    step = max(size / 2, np.sqrt(max(x1 - x0 - 2 * edge, 1) * max(y1 - y0 - 2 * edge, 1) / _PATCHES))
    xs = np.arange(x0 + edge, x1 - edge + 1e-9, step)
    ys = np.arange(y0 + edge, y1 - edge + 1e-9, step)
    return size, np.stack(np.meshgrid(np.round(xs), np.round(ys)), axis=-1).reshape(-1, 2)


def correlate_patches(
    left: ByteArray,
    right: ByteArray,
    motion: Rigid,
    points: FloatArray,
    *,
    size: tuple[int, int],
    search_px: int,
    threads: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shift (row, column), score and ratio of each patch of the left part in the resampled right part.

    Parameters
    ----------
    left, right : (rows, columns) uint8 arrays
    motion : Rigid
        Right part to left part.
    points : (N, 2) array
        Patch centres, whole pixels (x, y) of the left part.
    size : (rows, columns)
        Of a patch, even numbers.
    search_px : int
        Largest shift.
    threads : int

    Returns
    -------
    shift_rc : (N, 2) array, px
        NaN where there is no peak inside.
    score, ratio : (N,) arrays
        See `cosp.imaging.correlation.subpixel_peaks`.
    """
    rows, columns = size[0] // 2, size[1] // 2
    reach_r, reach_c = rows + search_px, columns + search_px

    def one(point: FloatArray) -> tuple[ByteArray, ByteArray]:
        x, y = int(point[0]), int(point[1])
        search = resample(right, motion, Window(y - reach_r, y + reach_r, x - reach_c, x + reach_c))
        return crop(left, Window(y - rows, y + rows, x - columns, x + columns)), search

    with ThreadPoolExecutor(threads) as pool:
        pairs = list(pool.map(one, points))
    if not pairs:
        return np.empty((0, 2)), np.empty(0), np.empty(0)
    templates = np.stack([p[0] for p in pairs]).astype(np.float32)
    return subpixel_peaks(ncc_surfaces(templates, np.stack([p[1] for p in pairs]).astype(np.float32)))


def crop(image: ByteArray, window: Window) -> ByteArray:
    """Pixels of a window that may reach beyond the image; 0 outside."""
    out = np.zeros((window.row1 - window.row0, window.column1 - window.column0), np.uint8)
    r0, r1 = max(window.row0, 0), min(window.row1, image.shape[0])
    c0, c1 = max(window.column0, 0), min(window.column1, image.shape[1])
    if r1 > r0 and c1 > c0:
        out[r0 - window.row0 : r1 - window.row0, c0 - window.column0 : c1 - window.column0] = image[r0:r1, c0:c1]
    return out


def resample(part: ByteArray, motion: Rigid, window: Window) -> ByteArray:
    """The part seen through a motion, in a window of the target frame; 0 where the part does not reach.

    Bicubic; only the pixels that the window needs are touched.
    """
    corners = np.array([[c, r] for c in (window.column0, window.column1) for r in (window.row0, window.row1)], float)
    back = motion.inverse()
    inside = back.apply(corners)
    low, high = np.floor(inside.min(axis=0)).astype(int) - 3, np.ceil(inside.max(axis=0)).astype(int) + 4
    box = Window(max(low[1], 0), min(high[1], part.shape[0]), max(low[0], 0), min(high[0], part.shape[1]))
    shape = (window.row1 - window.row0, window.column1 - window.column0)
    if box.row1 <= box.row0 or box.column1 <= box.column0:
        return np.zeros(shape, np.uint8)
    origin = back.apply(np.array([window.column0, window.row0], float)) - (box.column0, box.row0)
    c, s = np.cos(back.rotation_rad), np.sin(back.rotation_rad)
    matrix = np.array([[c, -s, origin[0]], [s, c, origin[1]]])
    return np.asarray(
        cv2.warpAffine(
            np.ascontiguousarray(part[box.row0 : box.row1, box.column0 : box.column1]),
            matrix,
            (shape[1], shape[0]),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
    )


def _grey_relation(left: ByteArray, right: ByteArray, motion: Rigid, points: FloatArray) -> tuple[float, float]:
    """Gain and offset that take grey values of the right part to those of the left one, from means of patches."""
    half = 16
    means = []
    for x, y in points[:: -(-len(points) // 300)].astype(int):
        window = Window(y - half, y + half, x - half, x + half)
        a, b = crop(left, window), resample(right, motion, window)
        whole = (a > 0) & (b > 0) & (a < 250) & (b < 250)
        if whole.mean() > 0.9:
            means.append((a[whole].mean(), b[whole].mean()))
    if len(means) < 8:
        return 1.0, 0.0
    a, b = np.array(means).T
    gain, offset = 1.0, float(np.median(a - b))
    kept = np.ones(len(a), bool)
    for _ in range(4):
        if a[kept].std() < 5.0 or b[kept].std() < 5.0:
            # Too little contrast in the overlap to tell a gain.
            gain, offset = 1.0, float(np.median(a - b))
        else:
            gain = float(a[kept].std() / b[kept].std())
            offset = float(np.mean(a[kept] - gain * b[kept]))
        misfit = a - gain * b - offset
        kept = np.abs(misfit - np.median(misfit)) < 3 * max(nmad(misfit), 0.3)
    return gain, offset


def require_part(
    name: str, *, shape: tuple[int, int], bands: int, dtype: str, pixel_mm: float, width_mm: tuple[float, float]
) -> None:
    """Stop where a raster cannot be a digitised part of a film.

    Parameters
    ----------
    name : str
        The file, for the message.
    shape : (rows, columns)
    bands : int
    dtype : str
    pixel_mm : float
        Stated size of a pixel.
    width_mm : (least, most)
        Plausible extent across the film.

    Raises
    ------
    InputError
    """
    if bands != 1 or dtype != "uint8":
        raise InputError(f"{name}: found {bands} band(s) of {dtype}; a digitised part has one band of uint8")
    across_mm = min(shape) * pixel_mm
    if shape[0] > shape[1]:
        raise InputError(f"{name}: {shape[1]} columns by {shape[0]} rows; a part is longer along its columns")
    if not width_mm[0] <= across_mm <= width_mm[1]:
        raise InputError(
            f"{name}: {shape[0]} rows of {1000 * pixel_mm:g} um are {across_mm:.1f} mm across the film; "
            f"{width_mm[0]:g} to {width_mm[1]:g} mm are possible: is pixel_um right?"
        )
