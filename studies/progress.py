"""Progress of long work on standard error."""

import sys
from typing import Any


def progress_bar(total: int, progress: bool, unit: str, line: str = "{elapsed}", done: int = 0) -> Any:
    """Return a progress bar; where no terminal is watching, a plain line every few seconds.

    Parameters
    ----------
    total, done : int
        How many there are, and how many of them are finished already.
    progress : bool
        Whether to show anything.
    unit : str
        What is counted.
    line : str
        What the plain line says behind the count, as tqdm's `bar_format` has it.
    """
    from tqdm import tqdm  # late: `--help` does without

    common = {"total": total, "initial": done, "unit": f" {unit}", "disable": not progress}
    if sys.stderr.isatty():
        return tqdm(**common)
    return tqdm(**common, bar_format=f"{{n_fmt}} of {{total_fmt}} {unit}, {line}\n", mininterval=5)
