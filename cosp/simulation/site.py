"""What a simulated site is to be, and the plan that follows from it: orbit, exposures, scene ids, corners, grids."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from pyproj import Transformer

from cosp.arrays import FloatArray
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.simulation.orbit import (
    FOCAL_LENGTH_MM,
    HALF_LENGTH_MM,
    HALF_WIDTH_MM,
    TILT_RAD,
    Exposure,
    Orbit,
    compensated,
    orbit_over,
)

EARTH_RADIUS_M = 6371e3
FRAMES_BETWEEN_FORE_AND_AFT = 6
_MISSIONS = {"KH-4": 9053, "KH-4A": 1040, "KH-4B": 1104}


@dataclass(frozen=True)
class SiteSettings:
    """Everything that may be chosen about a simulated site; each defect has its size, and zero switches it off.

    Sizes on film carry `_px` where they mean pixels of 7 µm, whatever the digitisation, so that a coarse film is the
    same film. Times of day and season enter as the place of the sun (azimuth from north over east).
    """

    name: str = "demo"
    seed: int = 1
    # camera and orbit
    camera: str = "KH-4B"
    mission: int = 0  # 0: one that flew this camera
    pass_number: int = 2169
    first_frame: int = 92
    date: str = "1968-08-12"
    descending: bool = True
    pairs: int = 1
    frame_overlap: float = 0.07
    altitude_km: float = 170.0
    inclination_deg: float = 82.9
    centre_longitude_deg: float = 98.0
    centre_latitude_deg: float = 44.0
    ground_height_m: float = 1200.0
    attitude_error_deg: float = 0.3
    attitude_rate_deg_s: float = 0.02
    wobble_arcsec: float = 0.5
    compensation_error: float = 0.02
    corner_error_km: float = 5.0
    # digitisation
    pixel_um: float = 56.0
    overlap_mm: float = 25.0
    part_rotation_deg: float = 0.3
    part_shift_mm: float = 0.6
    part_contrast: float = 0.06
    scanner_step_px: float = 0.0
    scanner_step_mm: float = 20.0
    # film
    bending_mm: float = 0.6
    distortion_px: float = 1.5
    distortion_length_mm: float = 60.0
    distortion_width_mm: float = 40.0
    shrinkage: float = 0.001
    grain_grey: float = 7.0
    scanner_noise_grey: float = 1.0
    gamma: float = 0.75
    saturation: float = 0.9
    vignetting: float = 0.25
    scratches: int = 25
    dust: int = 400
    marks: bool = True
    # ground
    dem: str | None = None
    dem_heights: str = "egm96"
    image: str | None = None
    terrain_m: float = 0.0  # 0: suited to the digitisation
    texture: float = 1.0
    sun_azimuth_deg: float = 118.0
    sun_elevation_deg: float = 36.0
    snow_line_m: float = 2950.0
    glacier_thinning_m: float = 40.0
    changed_share: float = 0.3
    # reference data, of the modern epoch
    modern_sun_azimuth_deg: float = 148.0
    modern_sun_elevation_deg: float = 48.0
    modern_snow_line_m: float = 3250.0
    reference_dem_m: float = 30.0
    reference_dem_noise_m: float = 2.5
    reference_dem_long_wave_m: float = 1.0
    reference_dem_crs: str = "auto"
    reference_image_m: float = 15.0
    reference_image_error_m: float = 3.0


@dataclass(frozen=True)
class ScenePlan:
    """One exposure to be made: id, look, how the camera moves, and the corners the archive would give."""

    scene: str
    look: str
    number: int
    exposure: Exposure
    corners_deg: FloatArray  # nw, ne, se, sw, each (latitude, longitude)
    seed: int


@dataclass(frozen=True)
class SitePlan:
    """All that follows from the settings without making anything."""

    settings: SiteSettings
    orbit: Orbit
    crs: str
    scenes: tuple[ScenePlan, ...]
    pairs: tuple[tuple[str, str, str], ...]
    terrain_grid: PixelGrid
    dem_resolution_m: float

    def scene(self, scene: str) -> ScenePlan:
        """The exposure with this id.

        Raises
        ------
        InputError
            If the site has no such scene.
        """
        for planned in self.scenes:
            if planned.scene == scene:
                return planned
        names = ", ".join(planned.scene for planned in self.scenes)
        raise InputError(f"{self.settings.name}: no scene {scene}; the simulated site has {names}")


def plan_site(settings: SiteSettings) -> SitePlan:
    """Orbit, exposures, sheet corners and grids of a site; cheap, and the same for the same settings.

    Raises
    ------
    InputError
        If the camera is unknown or a size makes no sense.
    """
    if settings.camera not in _MISSIONS:
        raise InputError(f"camera is {settings.camera!r}, needed is one of {', '.join(_MISSIONS)}")
    if settings.pairs < 1 or settings.pixel_um <= 0.0:
        raise InputError(f"{settings.name}: pairs and pixel_um must be positive")
    altitude_m = settings.altitude_km * 1e3
    orbit = orbit_over(
        settings.centre_longitude_deg,
        settings.centre_latitude_deg,
        altitude_m=altitude_m,
        inclination_deg=settings.inclination_deg,
        descending=settings.descending,
    )
    # The camera on its tilted ray, and how fast it passes over the turning ground.
    ground_radius = orbit.radius_m - altitude_m + settings.ground_height_m
    ahead = math.asin(orbit.radius_m / ground_radius * math.sin(TILT_RAD)) - TILT_RAD
    rate = orbit.rate_rad_s - 7.292115e-5 * math.cos(math.radians(settings.inclination_deg))
    base_s = 2.0 * ahead / rate
    slant = ground_radius * math.sin(ahead) / math.sin(TILT_RAD)
    width_m = 2.0 * HALF_WIDTH_MM / FOCAL_LENGTH_MM * slant / math.cos(TILT_RAD + ahead)
    cycle_s = width_m * (1.0 - settings.frame_overlap) / (rate * ground_radius)

    mission = settings.mission or _MISSIONS[settings.camera]
    scenes = []
    pairs = []
    for pair in range(settings.pairs):
        ids = {}
        for look, sign in (("fore", 1.0), ("aft", -1.0)):
            frame = settings.first_frame + pair + (0 if look == "fore" else FRAMES_BETWEEN_FORE_AND_AFT)
            direction = "D" if settings.descending else "A"
            ids[look] = f"DS{mission}-{settings.pass_number:04d}{direction}{look[0].upper()}{frame:03d}"
            middle_s = (pair - (settings.pairs - 1) / 2.0) * cycle_s - sign * base_s / 2.0
            number = 2 * pair + (look == "aft")
            exposure = _exposure(settings, orbit, middle_s, sign, np.random.default_rng([settings.seed, 11, number]))
            corner_rng = np.random.default_rng([settings.seed, 12, number])
            corners = _archive_corners(exposure, settings, corner_rng)
            scenes.append(ScenePlan(ids[look], look, number, exposure, corners, settings.seed * 1000 + number))
        first = settings.first_frame + pair
        name = f"{mission}-{settings.pass_number:04d}_{first:03d}-{first + FRAMES_BETWEEN_FORE_AND_AFT:03d}"
        pairs.append((name, ids["fore"], ids["aft"]))

    zone = int((settings.centre_longitude_deg + 180.0) // 6.0) % 60 + 1
    crs = f"EPSG:{(32600 if settings.centre_latitude_deg >= 0.0 else 32700) + zone}"
    gsd_m = altitude_m / FOCAL_LENGTH_MM * settings.pixel_um * 1e-3
    resolution = max(5.0, 5.0 * round(2.4 * gsd_m / 5.0))
    posting = settings.terrain_m or max(15.0, resolution)
    grid = PixelGrid.covering(_footprint_bounds(scenes, crs, margin_m=4000.0), posting)
    return SitePlan(settings, orbit, crs, tuple(scenes), tuple(pairs), grid, resolution)


def _exposure(settings: SiteSettings, orbit: Orbit, middle_s: float, sign: float, rng: np.random.Generator) -> Exposure:
    """The exposure of one frame; the fore camera (sign +1) looks ahead, its lens sweeps towards +x."""
    harmonics = 3
    falling = 1.0 / np.arange(1, harmonics + 1)
    exposure = Exposure(
        orbit=orbit,
        middle_s=middle_s,
        scan_direction=int(sign),
        tilt_rad=-sign * TILT_RAD,
        offsets_rad=np.radians(settings.attitude_error_deg) * rng.standard_normal(3),
        rates_rad_s=np.radians(settings.attitude_rate_deg_s) * rng.standard_normal(3),
        wobble_rad=np.radians(settings.wobble_arcsec / 3600.0) * rng.standard_normal((3, harmonics)) * falling,
        wobble_phase=rng.uniform(0.0, 2.0 * np.pi, (3, harmonics)),
        nodding_rad_s=0.0,
        lens_rate_mm_s=0.0,
    )
    error = settings.compensation_error * rng.standard_normal()
    lens = settings.camera != "KH-4B"
    return compensated(exposure, settings.ground_height_m, lens=lens, relative_error=float(error))


def _archive_corners(exposure: Exposure, settings: SiteSettings, rng: np.random.Generator) -> FloatArray:
    """Corners as an archive lists them: shifted as a whole, and rounded to minutes; nw, ne, se, sw (lat, lon)."""
    film = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * [HALF_LENGTH_MM, HALF_WIDTH_MM]
    if not settings.descending:
        film = -film  # flying north, x points west and y south
    lonlat = exposure.ground_at(film, settings.ground_height_m)[:, :2]
    bearing = rng.uniform(0.0, 2.0 * np.pi)
    degree_m = np.pi / 180.0 * EARTH_RADIUS_M
    shift = settings.corner_error_km * 1e3 / degree_m * np.array([np.sin(bearing), np.cos(bearing)])
    shift[0] /= np.cos(np.radians(settings.centre_latitude_deg))
    return np.round((lonlat + shift)[:, ::-1] * 60.0) / 60.0


def _footprint_bounds(scenes: list[ScenePlan], crs: str, *, margin_m: float) -> tuple[float, float, float, float]:
    """Map bounds of all that any film may see between sea level and the highest mountains."""
    transformer = Transformer.from_crs("EPSG:4979", crs, always_xy=True)
    x = np.linspace(-1.01, 1.01, 21)[:, None] * HALF_LENGTH_MM
    y = np.array([-1.06, 0.0, 1.06])[None, :] * HALF_WIDTH_MM
    film = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(-1, 2)
    lonlat = np.concatenate([scene.exposure.ground_at(film, 0.0)[:, :2] for scene in scenes])
    east, north = transformer.transform(lonlat[:, 0], lonlat[:, 1])
    return (east.min() - margin_m, north.min() - margin_m, east.max() + margin_m, north.max() + margin_m)


def without_defects(settings: SiteSettings) -> SiteSettings:
    """The same site on perfect film from a perfect scanner; marks of the camera stay."""
    return replace(
        settings,
        part_rotation_deg=0.0,
        part_shift_mm=0.0,
        part_contrast=0.0,
        scanner_step_px=0.0,
        bending_mm=0.0,
        distortion_px=0.0,
        shrinkage=0.0,
        grain_grey=0.0,
        scanner_noise_grey=0.0,
        vignetting=0.0,
        scratches=0,
        dust=0,
    )
