"""Errors of the project: each says what was found and what was needed."""


class CospError(Exception):
    """Root of every error the project raises on purpose."""


class InputError(CospError, ValueError):
    """A file, sheet or key that cannot be used as it is."""


class StitchingError(CospError):
    """Parts of a film that do not join with confidence."""


class PlacementError(CospError):
    """A frame that cannot be placed on the ground with confidence."""


class NotEnoughMatchesError(CospError):
    """Too few points remain to go on."""


class NoOverlapError(CospError):
    """Two things that should share ground do not."""
