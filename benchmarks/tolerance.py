"""How often the error that a tolerance states is exceeded: python -m benchmarks.tolerance [scenes]

The scenes and references are those of tests/test_tolerance.py, more of them; about 1 s a scene.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from test_tolerance import WANTED, random_scenes, reference

from hpgr import tolerance
from hpgr.run import run_scene


def main():
    """Print every figure whose true error exceeds the stated one, and the count."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    missed, figures = 0, 0
    for number, scene in enumerate(random_scenes(count)):
        estimate = tolerance.refine(scene, WANTED, run_scene)
        found, true = tolerance.figures_of(run_scene(estimate.scene).values), reference(scene)
        for name, stated in estimate.errors().items():
            error = tolerance.relative(found, true, name)
            figures += 1
            if abs(error) > stated:
                missed += 1
                print(f"scene {number}, {name}: error {error:+.4f}, stated {stated:.4f}; {scene.strength}")
    print(f"{missed} of {figures} figures exceed the stated error, at a tolerance of {WANTED}")


if __name__ == "__main__":
    main()
