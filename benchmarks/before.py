"""The frozen code that figures of speed are ratios to, loaded beside that of today in one process.

It is this repository's own, as it was before its kernels were rebuilt; its names are those of then.
"""

import subprocess
import sys
import tarfile
from importlib import import_module
from io import BytesIO
from pathlib import Path

COMMIT = "1e8ae26"
_ROOT = Path(__file__).parents[1]
FOLDER = _ROOT / ".benchmarks" / COMMIT


def unpack() -> None:
    """Take the frozen code from the history of the repository."""
    if FOLDER.exists():
        return
    archive = subprocess.run(["git", "archive", COMMIT, "hpgr", "studies"], cwd=_ROOT, capture_output=True)
    if archive.returncode:
        raise SystemExit(
            f"this clone has no commit {COMMIT}, with which is compared; fetch its whole history, as by "
            f"'git fetch --unshallow' ({archive.stderr.decode().strip()})"
        )
    with tarfile.open(fileobj=BytesIO(archive.stdout)) as packed:
        packed.extractall(FOLDER.with_suffix(".part"), filter="data")
    FOLDER.with_suffix(".part").rename(FOLDER)  # whole, or not there


class Before:
    """The frozen packages; `with before:` makes them those that imports find, as their late imports must."""

    def __init__(self):
        unpack()
        self._modules = {}
        with self:
            for name in ("hpgr.parcels", "hpgr.pipeline", "studies.bench", "studies.sweep"):
                import_module(name)
            self.hpgr, self.bench, self.sweep = (
                sys.modules["hpgr"],
                *map(import_module, ("studies.bench", "studies.sweep")),
            )

    def __enter__(self):
        sys.path.insert(0, str(FOLDER))
        self._modules = self._swapped(self._modules)

    def __exit__(self, *_):
        sys.path.remove(str(FOLDER))
        self._modules = self._swapped(self._modules)

    @staticmethod
    def _swapped(modules: dict) -> dict:
        known = [name for name in sys.modules if name.partition(".")[0] in ("hpgr", "studies")]
        others = {name: sys.modules.pop(name) for name in known}
        sys.modules.update(modules)
        return others
