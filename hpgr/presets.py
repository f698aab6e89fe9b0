"""Ready scenes. Their values, each with its source, are TOML files in data/presets; a scene file may begin with one."""

import tomllib

from hpgr.scene import DATA, Scene, check_scene, preset_names

NAMES = preset_names()

__all__ = ["DATA", "NAMES", "fitting_alike", "industrial", "khd_pilot", "paper"]


def paper() -> Scene:
    """Return the machine and quartz feed of the paper (section 3), rolls 1 m wide.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper()
    <hpgr.Scene: rolls 6000 mm x 1000 mm, gap 60 mm, 19 rpm; uniform feed to 60 mm; 10 x 200 x 1000>
    """
    return Scene.preset("paper")


def khd_pilot() -> Scene:
    """Return the KHD pilot rolls with porphyry, test P1 (Torres & Casali 2009), calibrated on pilot tests.

    The gap is the thickness of the cake (docs/validation.md).

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.khd_pilot()
    <hpgr.Scene: rolls 800 mm x 250 mm, gap 23.7 mm, 15.9951 rpm; table feed to 45 mm; 10 x 200 x 1000>
    """
    return Scene.preset("khd_pilot")


def industrial() -> Scene:
    """Return an example of an industrial machine of usual size with the porphyry of the pilot tests.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.industrial().flow.kind
    'nip'
    """
    return Scene.preset("industrial")


def fitting_alike(scene: Scene) -> dict[str, Scene]:
    """Return scenes with the ore constants that the tests behind a preset tell no worse than its own, by name.

    Empty unless the ore is that of the preset. Of `khd_pilot`, and so of `industrial`: two values of k, the scatter of
    strength, which decides what a change of feed does and is not told by tests of one feed.

    Examples
    --------
    >>> import hpgr
    >>> {name: one.strength.scatter for name, one in hpgr.presets.fitting_alike(hpgr.presets.industrial()).items()}
    {'k 0.31': 0.31, 'k 0.54': 0.54}
    >>> hpgr.presets.fitting_alike(hpgr.presets.paper())
    {}
    """
    check_scene(scene)
    fitted = khd_pilot()
    if (scene.strength, scene.fragments) != (fitted.strength, fitted.fragments):
        return {}
    with open(DATA / "khd_pilot_alike.toml", "rb") as file:
        return {name: scene.with_values(values) for name, values in tomllib.load(file).items()}
