"""One log file per job: messages, warnings and the traceback of a failure."""

from __future__ import annotations

import logging
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def log_to(path: str | Path) -> Iterator[None]:
    """Send log messages, warnings and any traceback of the block to a file.

    The error goes on after it was written. Its message is also printed, so that a user
    who watches the terminal sees what is wrong without opening a file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handler = logging.FileHandler(path, mode="w", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s", "%H:%M:%S"))
    root = logging.getLogger()
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)
    warnings.simplefilter("default")
    started, used = time.monotonic(), time.process_time()
    try:
        yield
        logging.getLogger("cosp").info(
            "done in %.1f s (%.1f s of processor time)", time.monotonic() - started, time.process_time() - used
        )
    except BaseException as error:
        root.error("%s", traceback.format_exc())
        print(f"{type(error).__name__}: {error} (log: {path})", file=sys.stderr)
        raise
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        root.setLevel(level)
        handler.close()
