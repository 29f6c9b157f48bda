"""Names under which files are written until they are whole."""

from __future__ import annotations

import os
from pathlib import Path


def temporary_for(path: Path) -> Path:
    """Sibling to write to before renaming; what killed writers of the same file left behind is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Also what lies beside it for a while, such as overviews.
    for left in path.parent.glob(f".{path.stem}.*.part*"):
        writer = left.name.removeprefix(f".{path.stem}.").partition(".part")[0]
        if writer.isdigit() and not _runs(int(writer)):
            left.unlink(missing_ok=True)
    return path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
