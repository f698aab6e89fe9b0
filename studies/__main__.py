"""Any study by its name, from any folder: `hpgr gap-sweep ...` is `python -m studies.gap_sweep ...`."""

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path


def commands() -> dict[str, Path]:
    """Return the file of every study by its name."""
    known = {path.stem.replace("_", "-"): path for path in sorted(Path(__file__).parent.glob("[!_]*.py"))}
    return {one: path for one, path in known.items() if '__name__ == "__main__"' in path.read_text(encoding="utf-8")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study that the first argument names with the others; return its exit code."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    known = commands()
    if name in ("-h", "--help"):
        print("usage: hpgr STUDY [OPTIONS]; hpgr STUDY --help tells the options\n")
        for one, path in known.items():
            about = path.read_text(encoding="utf-8").splitlines()[0].strip('".')
            print(f"  {one:<12} {about.partition(': `')[0]}")
        return 0
    study = known.get(name.replace("_", "-"))
    if study is None:
        print(f"error: got {name!r}; must be one of {', '.join(known)}; such as hpgr gap-sweep", file=sys.stderr)
        return 2
    return import_module(f"studies.{study.stem}").main(rest)


if __name__ == "__main__":
    raise SystemExit(main())
